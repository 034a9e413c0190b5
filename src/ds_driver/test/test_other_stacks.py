# SPDX-License-Identifier: Apache-2.0
"""Commands of other ROS stacks: conversion between message types, and the frames that they answer."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ds_driver.control.bicycle import Geometry, MotionError
from ds_driver.control.other_stacks import KINDS, MotionRequest, StampMatcher, part, set_part

CAR = Geometry(wheelbase=2.7, max_steering_angle=0.5)
PATHS = {
    "twist": ("angular.z", "linear.x"),
    "twist_stamped": ("twist.angular.z", "twist.linear.x"),
    "ackermann": ("drive.steering_angle", "drive.speed"),
    "servo": ("angle", "throttle"),
    "autoware": ("lateral.steering_tire_angle", "longitudinal.velocity"),
}
"""Where the lateral and the longitudinal value of a message are."""


def zeros(*names: str) -> SimpleNamespace:
    return SimpleNamespace(**dict.fromkeys(names, 0.0))


def blank(kind: str) -> Any:
    """Make a message as a plain object with the fields of its .msg file."""
    header = SimpleNamespace(stamp=None)
    twist = SimpleNamespace(linear=zeros("x", "y", "z"), angular=zeros("x", "y", "z"))
    drive = zeros("steering_angle", "steering_angle_velocity", "speed", "acceleration", "jerk")
    lateral = zeros("steering_tire_angle", "steering_tire_rotation_rate")
    return {
        "twist": twist,
        "twist_stamped": SimpleNamespace(header=header, twist=twist),
        "ackermann": SimpleNamespace(header=header, drive=drive),
        "servo": zeros("angle", "throttle"),
        "autoware": SimpleNamespace(stamp=None, lateral=lateral, longitudinal=zeros("velocity", "acceleration")),
    }[kind]


def values(kind: str, message: Any) -> tuple[float, float]:
    """Return the lateral and the longitudinal value of a message."""
    lateral, longitudinal = PATHS[kind]
    return part(message, lateral), part(message, longitudinal)


def motion_of(kind: str, steering: float, forward: float) -> MotionRequest:
    if KINDS[kind].needs_throttle:
        return MotionRequest(steering, throttle=forward)
    return MotionRequest(steering, speed=forward)


LEFT = {
    # half of full steering to the left; forward 0.4 (m/s or throttle), by hand: 0.25 rad, 0.4 * tan(0.25) / 2.7 rad/s
    "twist": (0.4 * math.tan(0.25) / 2.7, 0.4),
    "twist_stamped": (0.4 * math.tan(0.25) / 2.7, 0.4),
    "ackermann": (0.25, 0.4),
    "servo": (0.5, 0.4),
    "autoware": (0.25, 0.4),
}
"""The same request in every message: positive is left in all of them (REP-103), but right in this project."""


@pytest.mark.parametrize("kind", KINDS)
def test_left_is_positive_in_messages_and_negative_in_this_project(kind: str) -> None:
    message = blank(kind)
    KINDS[kind].fill(message, motion_of(kind, -0.5, 0.4), CAR)
    assert values(kind, message) == pytest.approx(LEFT[kind])
    motion = KINDS[kind].read(message, CAR)
    assert motion.steering == pytest.approx(-0.5)
    assert (motion.throttle if KINDS[kind].needs_throttle else motion.speed) == pytest.approx(0.4)


@pytest.mark.parametrize("kind", KINDS)
def test_every_request_survives_the_round_trip(kind: str) -> None:
    rng = np.random.default_rng(1)
    for steering, forward in zip(rng.uniform(-1, 1, 50), rng.uniform(0.05, 1, 50), strict=True):
        message = blank(kind)
        sent = motion_of(kind, float(steering), float(forward))
        KINDS[kind].fill(message, sent, CAR)
        received = KINDS[kind].read(message, CAR)
        assert received.steering == pytest.approx(sent.steering)
        assert received.speed == pytest.approx(sent.speed) and received.throttle == pytest.approx(sent.throttle)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("which", [0, 1])
def test_values_that_are_not_finite_are_refused_by_name(kind: str, bad: float, which: int) -> None:
    message = blank(kind)
    KINDS[kind].fill(message, motion_of(kind, 0.1, 0.4), CAR)
    path = PATHS[kind][which]
    set_part(message, path, bad)
    with pytest.raises(MotionError, match=f"{path} is (nan|inf|-inf)"):
        KINDS[kind].read(message, CAR)


def test_steering_stops_at_full_lock_and_a_car_cannot_turn_on_the_spot() -> None:
    assert CAR.steering_of(2.0) == -1.0 and CAR.steering_of(-2.0) == 1.0
    assert CAR.angle_for(0.0, 1.0) == 0.0


@pytest.mark.parametrize("kind", KINDS)
def test_reverse_is_refused(kind: str) -> None:
    message = blank(kind)
    KINDS[kind].fill(message, motion_of(kind, 0.0, 0.4), CAR)
    set_part(message, PATHS[kind][1], -0.5)
    with pytest.raises(MotionError, match="reverse"):
        KINDS[kind].read(message, CAR)


def test_a_pulse_width_is_not_taken_for_a_throttle() -> None:
    with pytest.raises(MotionError, match="pulse width"):
        KINDS["servo"].read(SimpleNamespace(angle=0.0, throttle=1_500_000.0), CAR)


@pytest.mark.parametrize(("wheelbase", "angle"), [(0.0, 0.5), (2.0, 0.0), (2.0, 1.6), (math.nan, 0.5)])
def test_an_impossible_geometry_is_refused(wheelbase: float, angle: float) -> None:
    with pytest.raises(MotionError, match="wheelbase"):
        Geometry(wheelbase, angle)


STEP = 50_000_000
Matching = StampMatcher[str, str]


@pytest.fixture
def matching() -> Matching:
    return StampMatcher()


def test_a_stamped_command_answers_its_frame_in_either_order(matching: Matching) -> None:
    assert matching.frame(STEP, "a") is None
    assert matching.command(STEP, "left") == ("a", "left")
    assert matching.command(2 * STEP, "right") is None
    assert matching.frame(2 * STEP, "b") == ("b", "right")


def test_repeated_late_and_unknown_stamps_are_refused(matching: Matching) -> None:
    matching.frame(STEP, "a")
    matching.command(STEP, "left")
    for stamp in (STEP, STEP // 2, 1_700_000_000 * 10**9):
        with pytest.raises(KeyError):
            matching.command(stamp, "again")
    assert matching.frame(2 * STEP, "b") is None


def test_a_command_without_stamp_answers_the_newest_frame_once_or_the_next(matching: Matching) -> None:
    matching.frame(STEP, "a")
    matching.frame(2 * STEP, "b")
    assert matching.command(0, "left") == ("b", "left")
    assert matching.command(0, "right") is None
    assert matching.command(0, "straight") is None
    assert matching.frame(3 * STEP, "c") == ("c", "straight")
    assert matching.frame(4 * STEP, "d") is None


def test_a_repeated_frame_can_be_answered_again(matching: Matching) -> None:
    for _ in range(2):
        assert matching.frame(STEP, "a") is None
        assert matching.command(STEP, "left") == ("a", "left")


def test_memory_is_bounded(matching: Matching) -> None:
    early: Matching = StampMatcher()
    for number in range(1, 2000):
        matching.frame(number * STEP, "frame")
        early.command(number * STEP, "command")
    assert len(matching._frames) <= 20 and len(early._early) <= 20
