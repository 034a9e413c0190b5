# SPDX-License-Identifier: Apache-2.0
"""What is true of every car that moves on a plane: signs, units, no memory, no preferred place or direction."""

from __future__ import annotations

import math

import numpy as np
import pytest
from benchmarks import physics
from numpy.typing import NDArray
from tests.evidence.subjects import Subject
from tests.observations import drive

from ds_sim.parts import Vehicle
from ds_sim.simulator import FRAME_TIME, Command, Outcome, VehicleState

RNG = np.random.default_rng(0)
PLACES = {"bullet": 1e-3, "softbody": 1e-9, "donkey": 1e-9, "panda": 1e-9}
"""Largest difference of a path that begins elsewhere, over its length: Bullet's solver has world axes."""
SPEEDS = {"bullet": 1e-3, "softbody": 2e-3, "donkey": 1e-3, "panda": 0.02}
"""Largest error of the mean speed: CommonRoad's is that of a body that leans over the axles, whose place it has."""
MIRROR = {"bullet": 0.01, "softbody": 1e-3, "donkey": 1e-9, "panda": 0.03}
"""Largest difference of a turn to the right from the mirror image of one to the left, relative."""
WHEELS = {"bullet": 1e-3, "softbody": 0.05, "donkey": 1e-3, "panda": 1e-9}
"""Largest relative error of the steering angle of a turn that has lasted."""


def slalom(car: Vehicle, frames: int = 120) -> list[VehicleState]:
    states = []
    for frame in range(frames):
        car.advance(Command(0.4 * math.sin(0.07 * frame), 0.4))
        states.append(car.state())
    return states


def places(states: list[VehicleState]) -> NDArray[np.float64]:
    return np.array([(s.x, s.y) for s in states])


def test_minus_one_is_left_and_the_car_is_symmetric(subject: Subject, car: Vehicle) -> None:
    left = drive(car, 80, -0.6, 0.4)[-1]
    car.reset(0.0, 0.0, 0.0, RNG)
    right = drive(car, 80, 0.6, 0.4)[-1]
    assert left.yaw > 0.3
    assert left.y > 0.5
    assert left.roll > 0.0005  # right side down, out of the bend
    assert left.steering_angle == pytest.approx(0.6 * subject.lock, rel=WHEELS[subject.name])
    assert (right.yaw, right.y, right.roll) == pytest.approx((-left.yaw, -left.y, -left.roll), rel=MIRROR[subject.name])


def test_straight_ahead_stays_straight_over_100_metres(subject: Subject, car: Vehicle) -> None:
    last = drive(car, 400, 0.0, 0.6)[-1]
    assert last.x > 100.0
    assert abs(last.y) < (1e-6 if subject.name == "softbody" else 0.05)


def test_speed_is_distance_over_time_and_yaw_the_sum_of_its_rates(subject: Subject, car: Vehicle) -> None:
    states = drive(car, 400, -0.8, 0.5)
    path = np.hypot(*np.diff(places(states), axis=0).T).sum()
    pace = np.mean([math.hypot(s.speed, s.lateral_speed) for s in states])
    assert path / (FRAME_TIME * (len(states) - 1)) == pytest.approx(pace, rel=SPEEDS[subject.name])
    assert states[-1].yaw > math.tau  # full turns count
    assert states[-1].yaw == pytest.approx(FRAME_TIME * sum(s.yaw_rate for s in states), rel=0.005)


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


@pytest.mark.parametrize("name", sorted(physics.cars()))
def test_halving_the_substep_changes_the_fitness_by_less_than_two_centimetres(name: str) -> None:
    """`python -m benchmarks.physics convergence` drives more roads; its numbers are in docs/simulators.md."""
    shifts, _ = physics.fitness_shift(physics.cars()[name], physics.random_roads(3), 2)
    assert 0.0 < max(shifts) < 0.02


@pytest.mark.parametrize("name", sorted(physics.cars()))
def test_the_autopilot_completes_roads_within_the_speed_limit(name: str) -> None:
    car = physics.cars()[name]
    vehicle = car.make(1)
    for road in physics.random_roads(2)[1:]:
        driven = physics.drive(car, vehicle, road)
        assert driven.outcome is Outcome.COMPLETED
        assert driven.path[:, 3].max() * 3.6 < 30.0
    vehicle.close()
