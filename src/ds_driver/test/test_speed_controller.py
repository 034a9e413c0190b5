# SPDX-License-Identifier: Apache-2.0
"""Throttle of the speed controller, on the simulators themselves."""

from __future__ import annotations

import pytest

from ds_driver.control.other_stacks import SpeedController
from ds_road import Road
from ds_sim.registry import make_simulator
from ds_sim.simulator import Command


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
