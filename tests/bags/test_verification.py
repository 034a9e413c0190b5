# SPDX-License-Identifier: Apache-2.0
"""Re-simulation of recorded runs, under their conditions: the same bits, or the first difference."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
from tests.bags.conftest import drive
from tests.command_line import ds

from ds_bags.layout import LEVELS, BagError, Level
from ds_bags.reader import BagReader, read_run
from ds_bags.run_writer import facts_of, write_bag
from ds_bags.verification import verify_bag
from ds_sim import DONKEY, SOFTBODY
from ds_sim.conditions.model import Conditions
from ds_sim.session import ResimulationError, RunRecord, difference_between, resimulate
from ds_sim.simulator import Command

pytestmark = pytest.mark.graph


@pytest.mark.parametrize("level", LEVELS)
def test_a_recorded_run_comes_out_the_same(bags: Path, level: Level) -> None:
    found = verify_bag(bags / level)
    assert (found.step, found.frames, found.images) == (None, 41, 0 if level == "telemetry" else 41)


def test_the_step_and_the_distance_of_a_changed_command_are_reported(run: RunRecord, tmp_path: Path) -> None:
    """A bag with another throttle than was driven: the car is at rest, so the difference shows a little later."""
    commands = list(run.commands)
    commands[20] = Command(commands[20].steering, 0.0)
    write_bag(tmp_path / "bag", "/twin", DONKEY, replace(run, commands=commands), {})
    found = verify_bag(tmp_path / "bag")
    assert found.step is not None and 21 <= found.step <= 23 and "m away" in found.difference
    done = ds("bag", "redrive", tmp_path / "bag", "--json")
    assert done.returncode == 1 and f"at step {found.step}, " in done.stderr
    document = json.loads(done.stdout)
    assert not document["same"] and document["step"] == found.step == document["frames"]


def test_one_bit_is_a_difference(run: RunRecord) -> None:
    seen = run.observations[30]
    moved = replace(seen, vehicle=replace(seen.vehicle, x=math.nextafter(seen.vehicle.x, math.inf)))
    assert difference_between(seen, seen) == ""
    apart = abs(moved.vehicle.x - seen.vehicle.x)
    assert difference_between(moved, seen) == f"{apart:.3g} m away (x by {apart:.3g})"
    signed = replace(seen, vehicle=replace(seen.vehicle, heave=-0.0))
    assert "heave by 0" in difference_between(signed, replace(seen, vehicle=replace(seen.vehicle, heave=0.0)))


def test_another_simulator_and_another_bag_are_reported(bags: Path, tmp_path: Path) -> None:
    found = verify_bag(bags / "raw", SOFTBODY)
    assert found.step == 1 and found.simulator == "softbody"
    with pytest.raises(BagError, match="no such bag"):
        verify_bag(tmp_path / "none")


CONDITIONS = Conditions(steering_lag=0.2, friction=1 / 3, visibility=80.0)


def test_a_bag_keeps_the_conditions_of_its_run(tmp_path: Path) -> None:
    run = drive(10, conditions=CONDITIONS)
    write_bag(tmp_path / "bag", "/ds1", DONKEY, run, {"driver": "constant"}, "compressed")
    with BagReader(tmp_path / "bag") as bag:
        found = read_run(bag)
    assert found.run.conditions == CONDITIONS
    assert len(list(resimulate(DONKEY, found.run))) == len(run.observations)
    found.run.scenario = replace(found.run.scenario, conditions=Conditions())
    with pytest.raises(ResimulationError):
        list(resimulate(DONKEY, found.run))


def test_default_conditions_leave_no_trace_in_a_bag() -> None:
    assert "conditions" not in facts_of(DONKEY, drive(10), "telemetry")


def test_damaged_conditions_get_one_line(tmp_path: Path) -> None:
    write_bag(tmp_path / "bag", "/ds1", DONKEY, drive(10, conditions=CONDITIONS), {"conditions": "fog=1"}, "telemetry")
    with BagReader(tmp_path / "bag") as bag, pytest.raises(BagError, match="unknown condition 'fog'"):
        read_run(bag)
