"""Parameter and launch files of ds_bringup."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml

from ds_sim.registry import SIMULATORS

FOLDER = Path(__file__).resolve().parents[1] / "src/ds_bringup/config/simulators"


def parameters(name: str) -> dict[str, dict[str, Any]]:
    nodes = yaml.safe_load((FOLDER / f"{name}.yaml").read_text())
    return {node.removeprefix("/**/"): values["ros__parameters"] for node, values in nodes.items()}


def test_every_simulator_has_a_file_and_every_file_a_simulator() -> None:
    assert {file.stem for file in FOLDER.glob("*.yaml")} == set(SIMULATORS)


def test_the_one_driver_of_all_asks_every_simulator() -> None:
    """Siblings in the order of the demo, then the twin, as the README starts them; no crop is repeated."""
    driver = yaml.safe_load((FOLDER.parent / "driver.yaml").read_text())["/driver"]["ros__parameters"]
    assert driver == {"network": "dave2_short", "namespaces": ["/ds1", "/ds2", "/twin"]}


@pytest.mark.parametrize("name", SIMULATORS)
def test_a_file_names_its_simulator_and_repeats_nothing_that_drivers_ask_for(name: str) -> None:
    nodes = parameters(name)
    assert set(nodes) == {"simulator"}
    assert nodes["simulator"]["simulator"] == name


LAUNCH_FILES = sorted((FOLDER.parents[1] / "launch").glob("*.launch.py"))


@pytest.mark.parametrize("path", LAUNCH_FILES, ids=lambda path: path.name.partition(".")[0])
def test_a_launch_ends_with_its_simulator(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With stand-ins for `launch`, which is not on PyPI; a campaign's simulators are restarted instead."""
    made: list[dict[str, Any]] = []

    class Anything:
        def __init__(self, *args: Any, **kwargs: Any) -> None:
            self.kwargs = kwargs

        def add_action(self, _action: Any) -> None: ...

        def perform(self, _context: Any) -> str:
            return str(FOLDER.parent / "demo.yaml")

    class Shutdown(Anything): ...

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
        stand_in.__getattr__ = lambda name: {"Node": Node, "Shutdown": Shutdown}.get(name, Anything)  # type: ignore[method-assign]
        monkeypatch.setitem(sys.modules, module, stand_in)
    described = runpy.run_path(str(path))
    described["generate_launch_description"]()
    if "nodes_of" in described:
        described["nodes_of"](None)
    simulators = [node for node in made if node["executable"] == "simulator"]
    assert simulators
    for node in simulators:
        assert node.get("respawn") or isinstance(node.get("on_exit"), Shutdown), node
