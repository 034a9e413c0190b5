# SPDX-License-Identifier: Apache-2.0
"""A bag keeps the conditions of its run: it re-simulates under them, bit for bit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from tests.bags.conftest import drive

from ds_bags.layout import BagError
from ds_bags.reader import BagReader, read_run
from ds_bags.run_writer import facts_of, write_bag
from ds_sim.conditions.model import Conditions
from ds_sim.registry import DONKEY
from ds_sim.session import ResimulationError, resimulate

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
