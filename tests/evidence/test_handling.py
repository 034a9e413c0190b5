# SPDX-License-Identifier: Apache-2.0
"""Compares the handling of every vehicle with textbook equations for its own constants."""

from __future__ import annotations

import math

import numpy as np
import pytest
from tests.evidence.bicycle import GRAVITY
from tests.evidence.conftest import Compare
from tests.evidence.subjects import SUBJECTS, Subject, settled, started, times
from tests.observations import drive

from ds_sim.parts import Vehicle
from ds_sim.simulator import FRAME_TIME

STEPS = {
    # Name of the vehicle, speed in road m/s, steering. These steps keep the tyres in their linear range (below 0.2 g)
    # and hardly change the speed; that of the twin is a whole number of pulse counts.
    "bullet_at_25_kmh": ("bullet", 7.0, -0.1),
    "softbody_at_25_kmh": ("softbody", 7.0, -0.05),
    "softbody_at_72_kmh": ("softbody", 20.0, -0.03),
    "donkey_at_25_kmh": ("donkey", 7.0, -9 / 85),
    "panda_at_25_kmh": ("panda", 7.0, -0.05),
}


@pytest.mark.parametrize("case", STEPS)
def test_the_response_to_a_steering_step_is_that_of_the_single_track_model(case: str, compare: Compare) -> None:
    """Compares the yaw rate over time with SciPy: whole curve, rise time and overshoot."""
    name, speed, steering = STEPS[case]
    subject = SUBJECTS[name]()
    car = started(subject)
    throttle = settled(car, speed)
    before = car.state().speed
    # The rate is smooth between frames; 40 frames are 2 s.
    measured = np.array([0.0, *(s.yaw_rate for s in drive(car, 40, steering, throttle))])
    angle = -steering * subject.lock
    car.close()

    oracle = (subject.sudden or subject.model).yaw_rate(before / subject.scale, subject.steered(angle), times(40))
    at, by = f"step at {3.6 * speed:.0f} km/h: ", "SciPy, single track"
    # Measured: 0.15% for tyres that do not slip; 1.5 to 2.6% for those that do, increasing with steering, because
    # they soften with growing slip and those of the oracle do not.
    band = 0.04 if subject.model.slips else 0.005
    worst = int(np.abs(measured - oracle).argmax())
    compare(
        name, at + "yaw rate where it is furthest off, rad/s", by, measured[worst], oracle[worst], off=band * oracle[-1]
    )
    compare(name, at + "rise to 90%, s", by, rise_time(measured), rise_time(oracle), off=0.01)
    compare(name, at + "peak over end", by, measured.max() / measured[-1], oracle.max() / oracle[-1], off=0.02)


def rise_time(rates: np.ndarray[tuple[int], np.dtype[np.float64]]) -> float:
    """s from the step until the rate first reaches 90% of its end value."""
    at = int(np.argmax(rates >= 0.9 * rates[-1]))
    share = (0.9 * rates[-1] - rates[at - 1]) / (rates[at] - rates[at - 1])
    return (at - 1 + float(share)) * FRAME_TIME


@pytest.mark.parametrize("speed", [3.0, 7.0])
def test_a_steady_circle_has_the_radius_that_steering_and_speed_give(
    subject: Subject, car: Vehicle, speed: float, compare: Compare
) -> None:
    """Gillespie ch. 6: R = (L + K v^2) / angle, K from the axles' slip stiffnesses, 0 without slip."""
    throttle = settled(car, speed)
    steering = subject.circle
    last = drive(car, 80, steering, throttle)[-1]
    model = subject.model
    angle = math.tan(steering * subject.lock)
    radius = (model.wheelbase + model.understeer_gradient * (last.speed / subject.scale) ** 2) / angle
    assert last.yaw_rate < 0.0
    what, driven = f"radius at {3.6 * speed:.0f} km/h, road m", -last.speed / last.yaw_rate
    compare(subject.name, what, "(L + K v^2) / angle", driven, radius * subject.scale, rel=0.02)


def test_the_understeer_gradient_follows_from_the_axles(subject: Subject, car: Vehicle, compare: Compare) -> None:
    """Steering angle lost on a faster circle per lateral acceleration, in degrees per g."""
    points = []
    for speed in (3.0, subject.fast):
        throttle = settled(car, speed)
        last = drive(car, 80, subject.circle, throttle)[-1]
        curvature = -last.yaw_rate / last.speed * subject.scale
        points.append((subject.model.wheelbase * curvature, curvature * (last.speed / subject.scale) ** 2))
        car.reset(0.0, 0.0, 0.0, np.random.default_rng(0))
    (slow, slow_lateral), (fast, fast_lateral) = points
    per_g = math.degrees((slow - fast) / (fast_lateral - slow_lateral)) * GRAVITY
    by_hand = math.degrees(subject.model.understeer_gradient) * GRAVITY
    within = {"rel": 0.05} if subject.model.slips and not subject.absolute else {"off": 0.05}
    compare(subject.name, "understeer, degrees per g", "both axles' slip and bushes, by hand", per_g, by_hand, **within)


def test_coasting_to_a_stop_takes_the_distance_that_follows_from_the_forces(
    subject: Subject, car: Vehicle, compare: Compare
) -> None:
    """Coasting is the only way to brake: m dv/dt = -c - k min(v, v_f), solved by hand.

    Above the fade speed (v^2 - v_f^2) m / 2 / (c + k v_f); below it m/k (v - c/k ln(1 + k v / c)).
    """
    settled(car, 7.0)
    first = car.state()
    states = drive(car, 200, 0.0, 0.0)
    speed = first.speed / subject.scale
    slope = subject.regeneration / subject.fade_speed
    constant, mass = subject.coasting_force, subject.mass
    slow = min(speed, subject.fade_speed)
    distance = mass / slope * slow
    if constant:
        distance -= mass / slope * constant / slope * math.log1p(slope * slow / constant)
    distance += 0.5 * mass * (speed**2 - slow**2) / (constant + subject.regeneration)
    # Until the motor has followed the pedal it continues to drive: adds the speed times the delay.
    distance += speed * subject.coasting_delay
    assert abs(states[-1].speed) < 1e-3
    what, by = "stopping distance from 25 km/h, road m", "m dv/dt = -c - k v, by hand"
    compare(subject.name, what, by, states[-1].x - first.x, distance * subject.scale, rel=0.02)


def test_the_nose_dips_in_proportion_to_the_deceleration(subject: Subject, car: Vehicle, compare: Compare) -> None:
    """Change of pitch = moment of inertial forces / (stiffness of springs minus effect of the leaning weight)."""
    settled(car, 7.0)
    cruising = car.state().pitch
    states = drive(car, 30, 0.0, 0.0)
    speeds = np.array([s.speed for s in states]) / subject.scale
    slowing = -np.gradient(speeds, FRAME_TIME)
    pitch = np.array([s.pitch for s in states]) - cruising
    steady = slice(12, 24)
    assert slowing[steady].min() * subject.scale > 1.0
    expected = subject.pitch_per_deceleration * slowing[steady].mean()
    what, by = "pitch while slowing, degrees", "moment over springs, by hand"
    compare(subject.name, what, by, math.degrees(pitch[steady].mean()), math.degrees(expected), rel=0.05)
