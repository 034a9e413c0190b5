# SPDX-License-Identifier: Apache-2.0
"""Parameter and launch files of ds_bringup."""

from __future__ import annotations

import os
import runpy
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.etree import ElementTree

import pytest
import yaml
from tests.graph.test_interfaces import tables
from tests.test_layers import imports

from ds_sim.registry import STANDARD

FOLDER = Path(__file__).resolve().parents[1] / "src/ds_bringup/config/simulators"


def test_every_simulator_has_a_file_that_names_it_and_repeats_nothing_that_drivers_ask_for() -> None:
    files = {file.stem: yaml.safe_load(file.read_text()) for file in FOLDER.glob("*.yaml")}
    assert set(files) == set(STANDARD)
    for name, nodes in files.items():
        assert list(nodes) == ["/**/simulator"], name
        assert nodes["/**/simulator"]["ros__parameters"]["simulator"] == name


WATCH = FOLDER.parents[1] / "launch/watch.launch.py"
LAUNCH_FILES = sorted({*WATCH.parent.glob("*.launch.py")} - {WATCH})


def launched(
    path: Path, monkeypatch: pytest.MonkeyPatch, words: dict[str, set[str]] | None = None, **arguments: str
) -> list[dict[str, Any]]:
    """Run a launch file with stand-ins for `launch`, which is not on PyPI; return the arguments of its nodes.

    `words` gets the first argument of everything that is made, by its class.
    """
    made: list[dict[str, Any]] = []

    class Anything:
        def __init__(self, *args: Any, **kwargs: Any) -> None:
            self.args, self.kwargs = args, kwargs
            if words is not None and args and isinstance(args[0], str):
                words.setdefault(type(self).__name__, set()).add(args[0])

        def perform(self, _context: Any) -> str:
            return arguments.get(self.args[0], str(FOLDER.parent / "demo.yaml"))

    class Node(Anything):
        def __init__(self, **kwargs: Any) -> None:
            super().__init__(**kwargs)
            made.append(kwargs)

    class IncludeLaunchDescription(Anything):
        def __init__(self, source: Any, launch_arguments: Iterable[tuple[str, str]]) -> None:
            *_, file = source.args[0].args[0]
            included: dict[str, set[str]] = {}
            made.extend(launched(WATCH.with_name(file), monkeypatch, included))
            assert {name for name, _ in launch_arguments} <= included["DeclareLaunchArgument"]

    def stand_in_for(name: str) -> Any:
        own = {"Node": Node, "Shutdown": _Shutdown, "IncludeLaunchDescription": IncludeLaunchDescription}
        return own.get(name) or type(name, (Anything,), {})

    for module in (
        "launch", "launch.actions", "launch.conditions", "launch.launch_description_sources", "launch.substitutions",
        "launch.event_handlers", "launch.events", "launch_ros", "launch_ros.actions",
        "launch_ros.parameter_descriptions", "launch_ros.substitutions",
    ):  # fmt: skip
        stand_in = ModuleType(module)
        stand_in.__getattr__ = stand_in_for  # type: ignore[method-assign]
        monkeypatch.setitem(sys.modules, module, stand_in)
    described = runpy.run_path(str(path))
    described["generate_launch_description"]()
    if "nodes_of" in described:
        described["nodes_of"](None)
    return made


def installed_in(monkeypatch: pytest.MonkeyPatch, prefix_of: Callable[[str], str]) -> None:
    """Let launch files find packages in the prefix that a function gives; a LookupError is that there is none."""
    packages: Any = ModuleType("ament_index_python.packages")
    packages.PackageNotFoundError, packages.get_package_prefix = LookupError, prefix_of
    monkeypatch.setitem(sys.modules, "ament_index_python.packages", packages)


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


TOOLS = {"foxglove_bridge", "rviz2"}
"""What `watch.launch.py` starts if it is installed; no dependency."""


@pytest.mark.graph
@pytest.mark.parametrize("path", [*LAUNCH_FILES, WATCH], ids=lambda path: path.name.partition(".")[0])
def test_what_a_launch_file_names_is_there(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What `ros2 launch` looks up: packages, executables, arguments, parameters; and what rosdep installs for it."""
    from ament_index_python.packages import get_package_prefix

    with monkeypatch.context() as patched:
        installed_in(patched, str)
        words: dict[str, set[str]] = {}
        options = {"port": "8765", "campaign": "out"}
        made = [node for tool in ("rviz", "foxglove") for node in launched(path, patched, words, tool=tool, **options)]
    manifest = ElementTree.parse(path.parents[1] / "package.xml")
    depends = {element.text for element in manifest.findall("exec_depend")}
    assert imports(path) - set(sys.stdlib_module_names) <= depends
    assert {node["package"] for node in made} - TOOLS <= depends
    assert words.get("LaunchConfiguration", set()) <= words["DeclareLaunchArgument"]
    assert words.get("FindPackageShare", set()) <= {"ds_bringup"}
    for node in made:
        if node["package"] in TOOLS:
            continue
        file = Path(get_package_prefix(node["package"]), "lib", node["package"], node["executable"])
        assert os.access(file, os.X_OK), file
        described = {row[0] for row in tables(node["executable"])[1]}
        for given in node.get("parameters", ()):
            assert not isinstance(given, dict) or set(given) <= described, node["executable"]


@pytest.mark.parametrize("file", [*FOLDER.glob("*.yaml"), FOLDER.parent / "driver.yaml"], ids=lambda file: file.stem)
def test_parameter_files_name_parameters_that_nodes_have(file: Path) -> None:
    for node, values in yaml.safe_load(file.read_text()).items():
        assert set(values["ros__parameters"]) <= {row[0] for row in tables(node.rpartition("/")[2])[1]}


def test_the_watch_launch_starts_a_tool_that_only_reads(monkeypatch: pytest.MonkeyPatch) -> None:
    def without(package: str) -> str:
        raise LookupError

    installed_in(monkeypatch, lambda package: "/opt")
    (bridge, page) = launched(WATCH, monkeypatch, tool="foxglove", port="8765", campaign="out")
    assert (bridge["package"], page["package"], page["arguments"]) == ("foxglove_bridge", "ds_orchestrator", ["out"])
    assert bridge["parameters"] == [{"address": "127.0.0.1", "port": 8765, "capabilities": ["connectionGraph"]}]
    (rviz,) = launched(WATCH, monkeypatch, tool="rviz", campaign="")
    assert rviz["executable"] == "rviz2" and rviz["arguments"][0] == "-d"
    assert launched(WATCH, monkeypatch, tool="none", campaign="") == []
    with pytest.raises(RuntimeError, match="tool 'x': expected foxglove, rviz or none"):
        launched(WATCH, monkeypatch, tool="x", campaign="")
    installed_in(monkeypatch, without)
    with pytest.raises(RuntimeError, match="apt install ros-jazzy-rviz2, or give tool:=none"):
        launched(WATCH, monkeypatch, tool="rviz", campaign="")
