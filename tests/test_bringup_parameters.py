# SPDX-License-Identifier: Apache-2.0
"""Parameter and launch files of ds_bringup."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml

from ds_sim.registry import STANDARD

FOLDER = Path(__file__).resolve().parents[1] / "src/ds_bringup/config/simulators"


def parameters(name: str) -> dict[str, dict[str, Any]]:
    nodes = yaml.safe_load((FOLDER / f"{name}.yaml").read_text())
    return {node.removeprefix("/**/"): values["ros__parameters"] for node, values in nodes.items()}


def test_every_simulator_has_a_file_and_every_file_a_simulator() -> None:
    assert {file.stem for file in FOLDER.glob("*.yaml")} == set(STANDARD)


def test_the_one_driver_of_all_asks_every_simulator() -> None:
    """Siblings in the order of the demo, then the twin, as the README starts them; no crop is repeated."""
    driver = yaml.safe_load((FOLDER.parent / "driver.yaml").read_text())["/driver"]["ros__parameters"]
    assert driver == {"network": "dave2_short", "namespaces": ["/ds1", "/ds2", "/twin"]}


@pytest.mark.parametrize("name", STANDARD)
def test_a_file_names_its_simulator_and_repeats_nothing_that_drivers_ask_for(name: str) -> None:
    nodes = parameters(name)
    assert set(nodes) == {"simulator"}
    assert nodes["simulator"]["simulator"] == name


WATCH = FOLDER.parents[1] / "launch/watch.launch.py"
LAUNCH_FILES = sorted({*WATCH.parent.glob("*.launch.py")} - {WATCH})


def launched(path: Path, monkeypatch: pytest.MonkeyPatch, **arguments: str) -> list[dict[str, Any]]:
    """Run a launch file with stand-ins for `launch`, which is not on PyPI; return the arguments of its nodes."""
    made: list[dict[str, Any]] = []

    class Anything:
        def __init__(self, *args: Any, **kwargs: Any) -> None:
            self.args, self.kwargs = args, kwargs

        def add_action(self, _action: Any) -> None: ...

        def perform(self, _context: Any) -> str:
            return arguments.get(self.args[0], str(FOLDER.parent / "demo.yaml"))

    class Node(Anything):
        def __init__(self, **kwargs: Any) -> None:
            super().__init__(**kwargs)
            made.append(kwargs)

    for module in (
        "launch", "launch.actions", "launch.conditions", "launch.substitutions", "launch.event_handlers",
        "launch.events", "launch_ros", "launch_ros.actions", "launch_ros.parameter_descriptions",
        "launch_ros.substitutions",
    ):  # fmt: skip
        stand_in = ModuleType(module)
        stand_in.__getattr__ = lambda name: {"Node": Node, "Shutdown": _Shutdown}.get(name, Anything)  # type: ignore[method-assign]
        monkeypatch.setitem(sys.modules, module, stand_in)
    described = runpy.run_path(str(path))
    described["generate_launch_description"]()
    if "nodes_of" in described:
        described["nodes_of"](None)
    return made


class _Shutdown:
    def __init__(self, **kwargs: Any) -> None: ...


@pytest.mark.parametrize("path", LAUNCH_FILES, ids=lambda path: path.name.partition(".")[0])
def test_a_launch_ends_with_its_simulator(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A campaign's simulators are restarted instead."""
    made = launched(path, monkeypatch)
    simulators = [node for node in made if node["executable"] == "simulator"]
    assert simulators
    for node in simulators:
        assert node.get("respawn") or isinstance(node.get("on_exit"), _Shutdown), node


def test_the_watch_launch_starts_a_tool_that_only_reads(monkeypatch: pytest.MonkeyPatch) -> None:
    def without(package: str) -> str:
        raise packages.PackageNotFoundError

    packages = ModuleType("ament_index_python.packages")
    packages.PackageNotFoundError = LookupError  # type: ignore[attr-defined]
    packages.get_package_prefix = lambda package: "/opt"  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "ament_index_python.packages", packages)
    (bridge, page) = launched(WATCH, monkeypatch, tool="foxglove", port="8765", campaign="out")
    assert (bridge["package"], page["package"], page["arguments"]) == ("foxglove_bridge", "ds_orchestrator", ["out"])
    assert bridge["parameters"] == [{"address": "127.0.0.1", "port": 8765, "capabilities": ["connectionGraph"]}]
    (rviz,) = launched(WATCH, monkeypatch, tool="rviz", campaign="")
    assert rviz["executable"] == "rviz2" and rviz["arguments"][0] == "-d"
    assert launched(WATCH, monkeypatch, tool="none", campaign="") == []
    with pytest.raises(RuntimeError, match="tool 'x': expected foxglove, rviz or none"):
        launched(WATCH, monkeypatch, tool="x", campaign="")
    packages.get_package_prefix = without  # type: ignore[attr-defined]
    with pytest.raises(RuntimeError, match="apt install ros-jazzy-rviz2, or give tool:=none"):
        launched(WATCH, monkeypatch, tool="rviz", campaign="")
