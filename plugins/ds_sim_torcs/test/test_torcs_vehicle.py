# SPDX-License-Identifier: Apache-2.0
"""The car against closed forms: steering, radius, drive, braking, grip; and that it drives alike everywhere."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ds_sim.simulator import FRAME_TIME, MAX_SPEED, Command, VehicleState
from ds_sim_torcs.host import TorcsHost
from ds_sim_torcs.parameters import TorcsParameters
from ds_sim_torcs.vehicle import TorcsVehicle

P = TorcsParameters()
GRAVITY = 9.81
# Of the car's file: tyres of 18 inches and 38% of 245 mm, first gear times final drive, wheels with their brakes.
WHEEL_RADIUS = 0.0254 * 9.0 + 0.38 * 0.245
GEAR_RATIO = 2.533333 * 6.0
WHEEL_INERTIA = 2 * (1.12 + 0.1241) + 2 * (1.22 + 0.0714)
TYRE_FRICTION = 1.6


def placed(host: TorcsHost, *, friction: float = 1.0, payload: float = 0.0) -> TorcsVehicle:
    vehicle = TorcsVehicle(host)
    vehicle.adjust(friction=friction, payload=payload)
    vehicle.reset(100.0, 50.0, 0.7, np.random.default_rng(0))
    return vehicle


def drive(vehicle: TorcsVehicle, frames: int, steering: float, throttle: float) -> list[VehicleState]:
    states = []
    for _ in range(frames):
        vehicle.advance(Command(steering, throttle))
        states.append(vehicle.state())
    return states


@pytest.mark.parametrize("steering", [-1.0, -0.5, 0.05, 1.0])
def test_a_command_is_its_share_of_the_mean_wheel_angle(host: TorcsHost, steering: float) -> None:
    last = drive(placed(host), 6, steering, 0.2)[-1]
    assert last.steering_angle == pytest.approx(-steering * P.max_steering_angle, abs=1e-5)


def test_left_and_right_wheel_stand_as_ackermann_says() -> None:
    """cot(outer) - cot(inner) is the track over the wheelbase, with the outer angle by simuv2's formula."""
    for mean in (0.05, 0.4, P.max_steering_angle):
        inner = P.inner_angle(mean)
        outer = math.atan2(P.wheelbase * math.tan(inner), P.wheelbase + P.track * math.tan(inner))
        assert 1 / math.tan(outer) - 1 / math.tan(inner) == pytest.approx(P.track / P.wheelbase)
        assert P.mean_angle(inner, outer) == pytest.approx(mean)
        assert P.mean_angle(-outer, -inner) == pytest.approx(-mean)


@pytest.mark.parametrize("steering", [-0.05, -0.3, 0.6, 1.0])
def test_a_slow_circle_has_the_kinematic_radius(host: TorcsHost, steering: float) -> None:
    """Wider by 5 to 8%: TORCS's limited-slip differentials and its rolling resistance oppose every turn.

    Of the mean, as the differentials let the yaw rate swing by an eighth, five times a second.
    """
    states = drive(placed(host), 300, steering, 0.25)[200:]
    curvature = math.tan(-steering * P.max_steering_angle) / P.wheelbase
    assert 0.5 < states[-1].speed < 5.0
    assert 1 / 1.09 < float(np.mean([s.yaw_rate / s.speed for s in states])) / curvature < 1.0


def test_it_speeds_up_by_its_share_of_the_engines_torque(host: TorcsHost) -> None:
    """At the idle speed of 1,000 rpm the engine has 363.5 N m, of which two differentials pass 0.9625 each."""
    states = drive(placed(host), 20, 0.0, 1.0)
    force = P.accelerator_share * 363.5 * GEAR_RATIO * 0.9625**2 / WHEEL_RADIUS
    force -= 0.013 * (P.mass + P.fuel) * GRAVITY
    mass = P.mass + P.fuel + WHEEL_INERTIA / WHEEL_RADIUS**2
    measured = (states[-1].speed - states[9].speed) / (10 * FRAME_TIME)
    assert measured == pytest.approx(force / mass, rel=0.1)


def test_the_limiter_holds_30_km_h(host: TorcsHost) -> None:
    states = drive(placed(host), 300, 0.0, 1.0)
    assert MAX_SPEED < states[-1].speed < MAX_SPEED + P.limiter_band
    assert states[-1].speed == pytest.approx(states[-40].speed, abs=0.02)


def test_it_stops_in_the_distance_that_its_forces_give(host: TorcsHost) -> None:
    """Brakes, the drag of the engine, rolling resistance and air, integrated from 25 km/h down to walking pace."""
    vehicle = placed(host)
    while vehicle.state().speed < 25.0 / 3.6:
        vehicle.advance(Command(0.0, 0.9))
    states = [vehicle.state(), *drive(vehicle, 400, 0.0, 0.0)]
    slow = next(k for k, state in enumerate(states) if state.speed < P.fade_speed)
    measured = math.dist((states[0].x, states[0].y), (states[slow].x, states[slow].y))
    mass = P.mass + P.fuel
    # Of both brakes of an axle: radius, piston area, friction, pressure and its share; of the file.
    brakes = 2 * 11e6 * 0.45 * (0.19 * 50e-4 * 0.55 + 0.165 * 25e-4 * 0.45)
    speed, expected = states[0].speed, 0.0
    while speed > P.fade_speed:
        engine = speed / WHEEL_RADIUS * GEAR_RATIO
        idle, most = 1000 * math.tau / 60, 10_000 * math.tau / 60
        drag = 0.33 * max(engine - idle, 0.0) / (most - idle) * 425.0 * GEAR_RATIO * 0.9625**2
        force = (P.brake_share * brakes + drag) / WHEEL_RADIUS + 0.013 * mass * GRAVITY
        force += 0.645 * 0.32 * 1.8 * speed**2
        expected += speed * 0.01
        speed -= force / (mass + WHEEL_INERTIA / WHEEL_RADIUS**2) * 0.01
    assert measured == pytest.approx(expected, rel=0.1)
    assert abs(states[-1].speed) < 0.05


@pytest.mark.parametrize("friction", [1.0, 0.5, 0.2])
def test_friction_limits_the_sideways_acceleration(host: TorcsHost, friction: float) -> None:
    """The tyres' friction falls with load by TORCS's law, to 1.05 of its nominal value under the static load."""
    vehicle = placed(host, friction=friction)
    drive(vehicle, 120, 0.0, 1.0)
    states = drive(vehicle, 100, -0.5, 1.0)[40:]
    east = np.array([s.speed * math.cos(s.yaw) - s.lateral_speed * math.sin(s.yaw) for s in states])
    north = np.array([s.speed * math.sin(s.yaw) + s.lateral_speed * math.cos(s.yaw) for s in states])
    acceleration = float(np.hypot(np.diff(east), np.diff(north)).mean()) / FRAME_TIME
    limit = friction * P.road_friction * TYRE_FRICTION * GRAVITY
    assert 0.75 * limit < acceleration < 1.06 * limit


def test_a_loaded_car_takes_longer_to_speed_up(host: TorcsHost) -> None:
    speeds = [drive(placed(host, payload=payload), 20, 0.0, 1.0)[-1].speed for payload in (0.0, 0.2, 0.5)]
    assert speeds[0] > speeds[1] > speeds[2] > 0.6 * speeds[0]


def test_it_rests_where_it_is_put(host: TorcsHost) -> None:
    vehicle = placed(host)
    first, last = vehicle.state(), drive(vehicle, 200, 0.0, 0.0)[-1]
    assert (first.x, first.y, first.yaw, first.speed) == (100.0, 50.0, 0.7, 0.0)
    assert math.dist((first.x, first.y), (last.x, last.y)) < 1e-3 and abs(last.roll) + abs(last.pitch) < 1e-4


def test_a_road_elsewhere_is_driven_alike(host: TorcsHost) -> None:
    """The same distances and speeds from any start, as the host always starts at its origin."""
    runs = []
    for x, y, yaw in ((0.0, 0.0, 0.0), (900.0, -700.0, 2.5)):
        vehicle = TorcsVehicle(host)
        vehicle.reset(x, y, yaw, np.random.default_rng(0))
        states = drive(vehicle, 60, 0.2, 0.8)
        runs.append([(s.speed, s.lateral_speed, s.yaw_rate, math.dist((s.x, s.y), (x, y))) for s in states])
    assert np.allclose(runs[0], runs[1], rtol=0.0, atol=1e-9)


def test_it_turns_over_more_than_a_full_circle(host: TorcsHost) -> None:
    states = drive(placed(host), 400, -1.0, 0.5)
    assert states[-1].yaw > 0.7 + math.tau and np.ptp(np.diff([s.yaw for s in states])) < 0.3


@pytest.mark.parametrize("change", [{"mass": 0.0}, {"neutral_throttle": 1.0}, {"accelerator_share": 1.5}])
def test_impossible_parameters_are_refused(change: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=rf"^{next(iter(change))} is .*: correct it$"):
        TorcsParameters(**change)
