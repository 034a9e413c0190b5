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


@pytest.mark.parametrize("name", SIMULATORS)
def test_the_nodes_around_a_simulator_get_its_crop_and_gains(name: str) -> None:
    spec = make_simulator(name).spec
    nodes = parameters(name)
    assert nodes["simulator"]["simulator"] == name
    assert nodes["driver"] == {"crop_top": [spec.crop_top], "crop_bottom": [spec.crop_bottom]}
    assert nodes["autopilot"] == {gain: [value] for gain, value in asdict(spec.autopilot).items()}
