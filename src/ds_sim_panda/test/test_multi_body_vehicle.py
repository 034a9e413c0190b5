# SPDX-License-Identifier: Apache-2.0
"""Compares the multi-body car with the package that publishes the model, values worked out by hand, and itself."""

from __future__ import annotations

import numpy as np
import pytest
from made_observations import drive
from vehiclemodels.vehicle_dynamics_mb import vehicle_dynamics_mb

from ds_sim.simulator import FRAME_TIME
from ds_sim_panda.simulator import MultiBodyVehicle
from ds_sim_panda.vehicle import parameters as published
from ds_sim_panda.vehicle.integration import derivative
from ds_sim_panda.vehicle.parameters import MultiBodyParameters

P = MultiBodyParameters()
RNG = np.random.default_rng(0)


@pytest.fixture
def car() -> MultiBodyVehicle:
    vehicle = MultiBodyVehicle()
    vehicle.reset(0.0, 0.0, 0.0, RNG)
    return vehicle


@pytest.mark.parametrize("number", [1, 2, 3])
def test_the_right_hand_side_is_that_of_the_package_at_random_states(number: int) -> None:
    rng = np.random.default_rng(number)
    reference = published.parameter_set(number)
    compiled = published.record(reference)
    rest = published.rest_state(number)
    spread = np.full(published.STATES, 0.05)
    spread[[published.X, published.Y, published.YAW]] = 100.0
    spread[[published.STEERING, published.YAW_RATE]] = 0.8
    spread[published.WHEEL_SPEEDS : published.WHEEL_SPEEDS + 4] = 10.0
    spread[[published.LATERAL_SPEED, published.FRONT_LATERAL_SPEED, published.REAR_LATERAL_SPEED]] = 1.0
    kinematic = 0
    for _ in range(1000):
        state = rest + spread * rng.standard_normal(published.STATES)
        state[published.SPEED] = rng.choice([rng.uniform(0.1, 15.0), rng.uniform(0.0, 0.12), rng.uniform(-1.0, 1.0)])
        kinematic += abs(state[published.SPEED]) < 0.1
        inputs = rng.uniform(-1.0, 1.0, 2) * (1.0, 15.0)
        found = np.empty(published.STATES)
        derivative(state.copy(), inputs, compiled, found)
        try:
            expected = vehicle_dynamics_mb(state.tolist(), inputs.tolist(), reference)
        except ZeroDivisionError:  # a wheel that stands while the car moves
            assert not np.isfinite(found).all()
            continue
        assert found == pytest.approx(expected, rel=1e-12, abs=1e-12)
    assert 100 < kinematic < 900


def test_a_start_does_not_spin_the_wheels_and_a_stop_is_final(car: MultiBodyVehicle) -> None:
    starting = drive(car, 40, 0.0, 1.0)
    assert all(b.speed > a.speed for a, b in zip(starting[:-1], starting[1:], strict=True))
    assert starting[-1].speed == pytest.approx(P.drive_acceleration * 2.0, rel=0.05)
    stopping = drive(car, 200, 0.0, 0.0)
    assert all(b.speed <= a.speed for a, b in zip(stopping[:-1], stopping[1:], strict=True))
    assert 0.0 <= stopping[-1].speed < 1e-2
    p = P.published
    rotating = 4 * p.I_y_w / p.R_w**2
    slowing = (stopping[5].speed - stopping[15].speed) / (10 * FRAME_TIME)
    assert slowing == pytest.approx(P.regenerative_deceleration * p.m / (p.m + rotating), rel=0.01)


def test_the_steering_has_the_published_rate(car: MultiBodyVehicle) -> None:
    angles = [0.0, *(s.steering_angle for s in drive(car, 60, 1.0, 0.0))]
    assert np.abs(np.diff(angles)).max() == pytest.approx(0.4 * FRAME_TIME)
    assert angles[-1] == pytest.approx(-0.91)


def test_another_version_of_the_model_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(published, "VERSION", "1.0")
    with pytest.raises(ImportError, match=r"^commonroad-vehicle-models is 3.0.2, expected 1.0: pip install \S+==1.0$"):
        MultiBodyVehicle()
