# SPDX-License-Identifier: Apache-2.0
"""Autopilot, speed controller, what is said of a driver's commands, and commands of other ROS stacks."""

from __future__ import annotations

import math
from operator import attrgetter
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from ds_driver.control.autopilot import Autopilot, throttle
from ds_driver.control.bicycle import Geometry, MotionError
from ds_driver.control.command_habits import command_habits
from ds_driver.control.other_stacks import KINDS, MotionRequest, SpeedController, StampMatcher, set_part
from ds_road import Road
from ds_sim.registry import make_simulator
from ds_sim.simulator import AutopilotGains, Command


@pytest.mark.parametrize(
    ("steering", "kmh", "expected"),
    [
        (0.0, 0.0, 1.0),
        (0.0, 15.0, 0.75),  # 1 - (15/30)^2
        (0.5, 15.0, 0.5),  # 1 - 0.25 - 0.25
        (0.0, 30.0, 0.0),
        (0.0, 31.0, 0.0),  # above the limit K = 15: 1 - (31/15)^2 < 0
        (-0.8, 12.0, 0.2),  # 1 - 0.64 - 0.16
        (1.0, 0.0, 0.5),  # start at full lock
        (1.0, 10.0, 0.0),
    ],
)
def test_throttle_is_equation_2(steering: float, kmh: float, expected: float) -> None:
    assert throttle(steering, kmh / 3.6) == pytest.approx(expected, abs=1e-9)


def test_steering_is_equation_1() -> None:
    pilot = Autopilot(AutopilotGains(proportional=0.4, derivative=2.0, integral=0.1))
    assert pilot.command(0.5, 0.0).steering == pytest.approx(-(0.4 * 0.5 + 0.0 + 0.1 * 0.5))
    assert pilot.command(0.6, 0.0).steering == pytest.approx(-(0.4 * 0.6 + 2.0 * 0.1 + 0.1 * 1.1))
    assert pilot.command(0.2, 0.0).steering == pytest.approx(-(0.4 * 0.2 - 2.0 * 0.4 + 0.1 * 1.3))


def test_steering_is_to_the_left_when_right_of_the_lane_and_is_clipped() -> None:
    pilot = Autopilot(AutopilotGains(proportional=3.0))
    assert pilot.command(1.0, 5.0) == Command(-1.0, 0.0)
    assert pilot.command(-1.0, 5.0).steering == 1.0


@pytest.mark.parametrize(("name", "target"), [("bullet", 5.0), ("softbody", 5.0), ("donkey", 3.0), ("donkey", 6.0)])
def test_the_target_speed_is_reached_and_held(name: str, target: float) -> None:
    simulator, control = make_simulator(name), SpeedController()
    observation = simulator.load(Road([(125.0, 25.0 * i) for i in range(9)]), seed=1)
    speeds = []
    for _ in range(160):
        observation = simulator.step(Command(0.0, control.throttle(target, observation.vehicle.speed)))
        speeds.append(observation.vehicle.speed)
    simulator.close()
    assert max(speeds) < target + 0.6
    assert speeds[-40:] == pytest.approx([target] * 40, abs=0.3)


def test_a_stop_releases_the_throttle_at_once() -> None:
    control = SpeedController()
    for _ in range(100):
        control.throttle(8.0, 3.0)
    assert control.throttle(0.0, 3.0) == 0.0
    assert control.throttle(3.0, 3.0) == 0.0


def test_the_integral_does_not_wind_up_while_the_throttle_is_full() -> None:
    """After a minute far below the target speed, the throttle falls as soon as the speed is slightly above it."""
    control = SpeedController()
    for _ in range(1200):
        assert control.throttle(8.0, 0.0) == 1.0
    assert control.throttle(8.0, 8.5) < 1.0


WAVE = 0.4 * np.sin(np.linspace(0.0, 20.0, 200))


@pytest.mark.parametrize(
    ("steering", "speed", "kinds"),
    [
        (WAVE, 7.0, []),
        (np.clip(25.0 * WAVE, -1.0, 1.0), 7.0, ["saturated"]),
        (np.full(200, 0.1), 7.0, ["constant"]),
        (WAVE, 0.5, ["crawls"]),
        (np.ones(200), 0.0, ["saturated", "constant", "crawls"]),
        (np.ones(10), 0.0, []),  # half a second says nothing
    ],
)
def test_names_what_is_unusual_about_commands(steering: NDArray[np.float64], speed: float, kinds: list[str]) -> None:
    found = command_habits(steering, np.full(len(steering) + 1, speed))
    assert [habit.kind for habit in found] == kinds


def test_says_the_share_of_saturated_commands() -> None:
    (habit,) = command_habits(np.repeat([1.0, -1.0, 0.3], [60, 32, 8]), np.full(100, 7.0))
    assert "92%" in habit.text


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
    assert attrgetter(*PATHS[kind])(message) == pytest.approx(LEFT[kind])
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
@pytest.mark.parametrize(
    ("which", "bad", "said"),
    [
        *((which, bad, f"{{}} is {bad}") for which in (0, 1) for bad in (math.nan, math.inf, -math.inf)),
        (1, -0.5, "reverse"),
    ],
)
def test_values_that_are_not_finite_and_reverse_are_refused(kind: str, which: int, bad: float, said: str) -> None:
    message, path = blank(kind), PATHS[kind][which]
    KINDS[kind].fill(message, motion_of(kind, 0.1, 0.4), CAR)
    set_part(message, path, bad)
    with pytest.raises(MotionError, match=said.format(path)):
        KINDS[kind].read(message, CAR)


def test_steering_stops_at_full_lock_and_a_car_cannot_turn_on_the_spot() -> None:
    assert CAR.steering_of(2.0) == -1.0 and CAR.steering_of(-2.0) == 1.0
    assert CAR.angle_for(0.0, 1.0) == 0.0


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
