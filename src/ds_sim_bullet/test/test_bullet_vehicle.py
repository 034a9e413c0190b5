# SPDX-License-Identifier: Apache-2.0
"""Compares the rigid-body car with textbook formulas, values worked out by hand, and itself."""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Iterator
from xml.etree import ElementTree

import numpy as np
import pytest
from tests.observations import drive

from ds_base.installation import missing_module
from ds_sim.registry import BULLET, SOFTBODY, UnknownSimulatorError, make_simulator, with_libraries
from ds_sim.simulator import FRAME_TIME, Command, VehicleState
from ds_sim_bullet.parameters import GRAVITY, BulletParameters
from ds_sim_bullet.vehicle import BulletVehicle
from ds_sim_bullet.world import car_urdf

P = BulletParameters()
RNG = np.random.default_rng(0)


@pytest.fixture
def car() -> Iterator[BulletVehicle]:
    vehicle = BulletVehicle()
    yield vehicle
    vehicle.close()


def test_vehicles_in_one_process_are_independent(car: BulletVehicle) -> None:
    def slalom(other: BulletVehicle | None) -> list[VehicleState]:
        car.reset(0.0, 0.0, 0.0, RNG)
        states = []
        for frame in range(60):
            states += drive(car, 1, 0.8 * math.sin(0.07 * frame), 0.5)
            if other is not None:
                drive(other, 1, -1.0, 1.0)
                if frame % 20 == 10:
                    other.reset(1.0, 2.0, 3.0, RNG)
        return states

    alone = slalom(None)
    other = BulletVehicle(dataclasses.replace(P, mass=1500.0))
    beside = slalom(other)
    other.close()
    assert beside == alone and len(set(alone)) == 60


def test_it_starts_where_reset_puts_it_and_stays_there_whatever_the_steering(car: BulletVehicle) -> None:
    car.reset(123.4, -56.7, 1.1, RNG)
    start = car.state()
    assert (start.x, start.y, start.yaw) == pytest.approx((123.4, -56.7, 1.1), abs=1e-12)
    for frame in range(300):
        car.advance(Command(0.7 if frame % 20 < 10 else -0.7, 0.0))
    last = car.state()
    assert math.hypot(last.x - start.x, last.y - start.y) < 1e-4
    assert (last.heave, last.roll, last.pitch) == pytest.approx((0.0, 0.0, 0.0), abs=1e-4)


def test_it_reaches_a_steady_speed_under_the_papers_throttle(car: BulletVehicle) -> None:
    speeds = [0.0]
    for _ in range(300):
        car.advance(Command(0.0, max(0.0, 1.0 - (speeds[-1] * 3.6 / 30.0) ** 2)))
        speeds.append(car.state().speed)
    kmh = 3.6 * np.array(speeds)
    assert 3.0 < np.argmax(kmh > 20.0) * FRAME_TIME < 4.0
    assert 22.0 < kmh[-1] < 27.0
    assert kmh[-1] - kmh[-20] < 0.05


def test_the_turning_circle_is_that_of_the_data_sheet() -> None:
    """8.6 m from kerb to kerb: the path of the outer front wheel."""
    rear = P.wheelbase / math.tan(P.max_steering_angle)
    assert 2.0 * math.hypot(rear + P.track / 2.0, P.wheelbase) == pytest.approx(8.6, abs=0.05)


def test_the_body_rolls_outwards_by_the_angle_its_springs_give(car: BulletVehicle) -> None:
    """Roll angle = m h a / (K - m g h), with K from springs and anti-roll bars."""
    states = drive(car, 250, -0.2, 0.7)[200:]
    acceleration = np.mean([math.hypot(s.speed, s.lateral_speed) * s.yaw_rate for s in states])
    springs = sum(P.spring_stiffness(front=front) for front in (True, False))
    stiffness = P.track**2 * (springs / 2.0 + P.front_anti_roll + P.rear_anti_roll)
    moment = P.sprung_mass * P.centre_of_mass_height
    assert acceleration > 3.0
    assert np.mean([s.roll for s in states]) == pytest.approx(
        moment * acceleration / (stiffness - moment * GRAVITY), rel=0.06
    )


def test_the_steering_rate_is_limited(car: BulletVehicle) -> None:
    angles = [0.0, *(s.steering_angle for s in drive(car, 30, 1.0, 0.0))]
    assert np.abs(np.diff(angles)).max() == pytest.approx(P.steering_rate * FRAME_TIME, rel=0.05)
    assert angles[-1] == pytest.approx(-P.max_steering_angle, rel=1e-3)


def test_the_urdf_has_the_mass_and_the_balance_of_the_car() -> None:
    robot = ElementTree.fromstring(car_urdf(P))
    masses = [float(mass.attrib["value"]) for mass in robot.iter("mass")]
    assert sum(masses) == pytest.approx(P.mass)
    moment = P.sprung_mass * P.body_forward / P.mass
    assert 0.5 + moment / P.wheelbase == pytest.approx(P.front_share)


def test_without_pybullet_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with pytest.raises(UnknownSimulatorError, match=r"^simulator 'bullet' cannot be loaded \(this needs pybullet"):
        make_simulator("bullet")
    there, left_out = with_libraries([BULLET, SOFTBODY])
    assert there == ["softbody"] and left_out == [f"bullet is left out: {missing_module('pybullet')}"]
