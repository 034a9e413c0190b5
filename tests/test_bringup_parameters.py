"""The parameter files of ds_bringup say what the simulators say of themselves."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
import yaml

from ds_sim.registry import SIMULATORS, make_simulator

FOLDER = Path(__file__).resolve().parents[1] / "src/ds_bringup/config/simulators"


def parameters(name: str) -> dict[str, dict[str, Any]]:
    nodes = yaml.safe_load((FOLDER / f"{name}.yaml").read_text())
    return {node.removeprefix("/**/"): values["ros__parameters"] for node, values in nodes.items()}


def test_every_simulator_has_a_file_and_every_file_a_simulator() -> None:
    assert {file.stem for file in FOLDER.glob("*.yaml")} == set(SIMULATORS)


def test_the_one_driver_of_all_gets_every_crop() -> None:
    """Siblings in the order of the demo, then the twin, as the README starts them by hand."""
    specs = [make_simulator(name).spec for name in ("bullet", "softbody", "donkey")]
    driver = yaml.safe_load((FOLDER.parent / "driver.yaml").read_text())["/driver"]["ros__parameters"]
    assert driver["namespaces"] == ["/ds1", "/ds2", "/twin"]
    assert driver["crop_top"] == [spec.crop_top for spec in specs]
    assert driver["crop_bottom"] == [spec.crop_bottom for spec in specs]


@pytest.mark.parametrize("name", SIMULATORS)
def test_the_nodes_around_a_simulator_get_its_crop_and_gains(name: str) -> None:
    spec = make_simulator(name).spec
    nodes = parameters(name)
    assert nodes["simulator"]["simulator"] == name
    assert nodes["driver"] == {"crop_top": [spec.crop_top], "crop_bottom": [spec.crop_bottom]}
    assert nodes["autopilot"] == {gain: [value] for gain, value in asdict(spec.autopilot).items()}
