# SPDX-License-Identifier: Apache-2.0
"""What is true of every car that moves on a plane: signs, units, no memory, no preferred place or direction."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.evidence.subjects import SUBJECTS, Subject, drive, started

from ds_sim.parts import Vehicle
from ds_sim.simulator import Command, VehicleState

RNG = np.random.default_rng(0)
PLACES = {"bullet": 1e-3, "softbody": 1e-9, "donkey": 1e-9, "panda": 1e-9}
"""Largest difference of a path that begins elsewhere, over its length: Bullet's solver has world axes."""
"""Largest error of the mean speed: CommonRoad's is that of a body that leans over the axles, whose place it has."""
"""Largest difference of a turn to the right from the mirror image of one to the left, relative."""
"""Largest relative error of the steering angle of a turn that has lasted."""


@pytest.fixture(params=sorted(SUBJECTS))
def subject(request: pytest.FixtureRequest) -> Subject:
    return SUBJECTS[request.param]()


@pytest.fixture
def car(subject: Subject) -> Iterator[Vehicle]:
    vehicle = started(subject)
    yield vehicle
    vehicle.close()


def slalom(car: Vehicle, frames: int = 120) -> list[VehicleState]:
    states = []
    for frame in range(frames):
        car.advance(Command(0.4 * math.sin(0.07 * frame), 0.4))
        states.append(car.state())
    return states


def places(states: list[VehicleState]) -> NDArray[np.float64]:
    return np.array([(s.x, s.y) for s in states])


@pytest.mark.parametrize("yaw", [0.3, 2.5])
def test_a_run_is_the_same_wherever_it_starts_and_after_anything(subject: Subject, car: Vehicle, yaw: float) -> None:
    here = slalom(car)
    drive(car, 40, -0.7, 1.0)
    car.reset(0.0, 0.0, 0.0, RNG)
    assert slalom(car) == here
    car.reset(200.0, -30.0, yaw, RNG)
    there = places(slalom(car)) - (200.0, -30.0)
    cos, sin = math.cos(yaw), math.sin(yaw)
    turned = np.stack((cos * there[:, 0] + sin * there[:, 1], cos * there[:, 1] - sin * there[:, 0]), axis=1)
    length = np.hypot(*np.diff(places(here), axis=0).T).sum()
    assert np.abs(turned - places(here)).max() < PLACES[subject.name] * length


@pytest.mark.parametrize("throttle", [0.3, 1.0])
def test_full_lock_stays_finite_and_moves(car: Vehicle, throttle: float) -> None:
    for steering in (1.0, -1.0):
        last = drive(car, 300, steering, throttle)[-1]
        assert all(math.isfinite(getattr(last, name)) for name in VehicleState.__slots__)
        assert math.hypot(last.speed, last.lateral_speed) > 0.05
        assert abs(last.roll) < math.radians(10.0)
