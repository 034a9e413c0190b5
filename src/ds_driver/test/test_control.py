# SPDX-License-Identifier: Apache-2.0
"""Autopilot, speed controller, and what is said of a driver's commands."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from ds_driver.control.autopilot import Autopilot, throttle
from ds_driver.control.command_habits import command_habits
from ds_driver.control.other_stacks import SpeedController
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
