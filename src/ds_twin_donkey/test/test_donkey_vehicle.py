# SPDX-License-Identifier: Apache-2.0
"""Compares the 1:16 car with textbook formulas, values worked out by hand, and itself."""

from __future__ import annotations

import math

import numpy as np
import pytest
from made_observations import drive

from ds_sim.simulator import FRAME_TIME, CommandError
from ds_twin_donkey.dynamics import CarState, rollout
from ds_twin_donkey.parameters import GRAVITY, SCALE, DonkeyParameters
from ds_twin_donkey.simulator import DonkeyVehicle

P = DonkeyParameters()
X, Y, YAW, SPEED, SERVO, WHEELS = map(CarState._fields.index, ("x", "y", "yaw", "speed", "servo", "steering_angle"))


def standing() -> DonkeyVehicle:
    car = DonkeyVehicle(P)
    car.reset(0.0, 0.0, 0.0, np.random.default_rng(0))
    return car


def test_the_vehicle_is_the_rollout_in_road_metres() -> None:
    car, time = standing(), np.arange(100) * FRAME_TIME
    commands = np.column_stack((0.8 * np.sin(2.0 * time), 0.3 + 0.2 * np.cos(0.7 * time)))
    driven = [drive(car, 1, *command)[0] for command in commands.tolist()]
    states = [(s.x / SCALE, s.y / SCALE, s.yaw, s.speed / SCALE) for s in driven]
    np.testing.assert_allclose(states, rollout(P, commands)[1:, [X, Y, YAW, SPEED]], rtol=0, atol=1e-12)


@pytest.mark.parametrize("share", [0.5, 0.6])
def test_reset_places_the_centre_of_the_car(share: float) -> None:
    car = DonkeyVehicle(P.changed(front_share=share))
    car.reset(7.0, 5.0, 2.0, np.random.default_rng(0))
    state = car.state()
    assert (state.x, state.y, state.yaw) == pytest.approx((7.0, 5.0, 2.0))
    assert (state.speed, state.yaw_rate, state.lateral_speed, state.roll, state.pitch) == (0.0,) * 5


@pytest.mark.parametrize("steering", [-1.0, 0.0, 1.0])
def test_the_smallest_throttle_above_the_dead_band_moves_it_even_at_full_lock(steering: float) -> None:
    first_count = math.ceil(P.throttle_dead_band * P.throttle_pulse_steps) / P.throttle_pulse_steps
    last = drive(standing(), 200, steering, first_count)[-1]
    assert math.hypot(last.speed, last.lateral_speed) > 0.3


def test_the_steady_speed_balances_motor_and_rolling_resistance() -> None:
    """stall (duty - v / free) = c m g."""
    throttle = 0.4
    last = drive(standing(), 200, 0.0, throttle)[-1]
    above = (throttle - P.throttle_dead_band) / (1.0 - P.throttle_dead_band)
    duty = P.start_duty + (P.full_duty - P.start_duty) * above
    speed = P.free_speed * (duty - P.rolling_resistance * P.mass * GRAVITY / P.stall_force)
    assert last.speed == pytest.approx(SCALE * speed, rel=1e-3)


def test_the_body_rolls_outwards_by_the_angle_its_springs_give() -> None:
    """Roll angle = m h a / (k - m g h), where the natural frequency gives k - m g h = I (2 pi f)^2."""
    last = drive(standing(), 200, -0.5, 0.4)[-1]
    lateral = last.yaw_rate * math.hypot(last.speed, last.lateral_speed) / SCALE
    stiffness = P.roll_inertia * (math.tau * P.roll_frequency) ** 2
    assert last.roll == pytest.approx(P.mass * P.centre_of_mass_height * lateral / stiffness, rel=0.03)


def test_a_command_arrives_after_its_delay_and_no_earlier() -> None:
    for delay, frames in ((0.0, 0), (0.05, 1), (0.12, 2)):
        states = rollout(P.changed(command_delay=delay), np.tile((-1.0, 0.0), (6, 1)))
        assert np.flatnonzero(states[1:, SERVO])[0] == frames


def test_the_servo_rate_is_limited() -> None:
    servo = rollout(P, np.tile((1.0, 0.0), (12, 1)))[:, SERVO]
    assert np.abs(np.diff(servo)).max() == pytest.approx(P.servo_rate * FRAME_TIME, rel=1e-9)
    assert servo[-1] == pytest.approx(-P.max_steering_angle, rel=1e-3)


def test_wheels_do_not_move_until_the_play_is_taken_up() -> None:
    commands = np.concatenate((np.tile((0.5, 0.0), (20, 1)), np.tile((0.5 - 1.5 / 85, 0.0), (20, 1))))
    wheels = rollout(P, commands)[:, WHEELS]
    back = 0.5 - round(85 * (0.5 - 1.5 / 85)) / 85
    assert abs(back) * P.max_steering_angle < P.servo_backlash
    assert wheels[-1] == pytest.approx(wheels[20], abs=1e-6)


def test_invalid_parameters_and_commands_are_refused_in_one_line() -> None:
    with pytest.raises(ValueError, match=r"^mass is nan, expected a number from 1e-06 to inf: correct it$"):
        P.changed(mass=math.nan)
    with pytest.raises(ValueError, match=r"^wheel_base is not a parameter of the car"):
        P.changed(wheel_base=0.2)
    with pytest.raises(ValueError, match=r"^commands have shape \(3,\), expected \(n, 2\)"):
        rollout(P, np.zeros(3))
    with pytest.raises(CommandError):
        rollout(P, [(0.0, math.nan)])
