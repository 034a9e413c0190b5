# SPDX-License-Identifier: Apache-2.0
"""The paper's two control laws, worked by hand."""

from __future__ import annotations

import pytest

from ds_driver.control.autopilot import Autopilot, throttle
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
