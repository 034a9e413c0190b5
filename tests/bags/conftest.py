# SPDX-License-Identifier: Apache-2.0
"""A short drive, recorded at every level."""

from __future__ import annotations

from pathlib import Path

import pytest

from ds_bags.layout import LEVELS
from ds_bags.run_writer import write_bag
from ds_driver.closed_loop.simulation import make_driver
from ds_road import Road
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.registry import DONKEY, make_simulator
from ds_sim.scenario import Scenario
from ds_sim.session import RunRecord, Session
from ds_sim.simulator import Outcome

FRAMES = 40
ROAD = Road([(125.0 + 8.0 * (i % 2), 25.0 * i) for i in range(9)])


def drive(frames: int = FRAMES, *, road: Road = ROAD, conditions: Conditions = DEFAULT) -> RunRecord:
    """Drive the twin with the autopilot, for a number of frames."""
    simulator = make_simulator("donkey")
    driver, session = make_driver("autopilot", simulator.spec), Session(simulator)
    observation = session.start(Scenario(road, conditions, seed=3))
    while observation is not None and session.driving and observation.step < frames:
        observation = session.advance(driver(observation))
    session.end(Outcome.CANCELLED, "that is enough")
    simulator.close()
    assert session.run is not None
    return session.run


@pytest.fixture(scope="session")
def run() -> RunRecord:
    return drive()


@pytest.fixture(scope="session")
def left_run() -> RunRecord:
    """A few frames in the left lane."""
    return drive(5, road=ROAD.in_lane("left"))


@pytest.fixture(scope="session")
def bags(run: RunRecord, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a bag of each level, named after it; tests must not write to it."""
    folder = tmp_path_factory.mktemp("bags")
    for level in LEVELS:
        write_bag(folder / level, "/twin", DONKEY, run, {"driver": "autopilot"}, level)
    return folder
