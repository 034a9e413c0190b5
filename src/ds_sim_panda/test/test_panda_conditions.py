"""Conditions of camera, sensor and car on the simulator `panda`; those of its world are not realised yet."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ds_sim.conditions.model import Conditions, NotApplicableError
from ds_sim.conditions.text import parse_conditions
from ds_sim.registry import make_simulator
from ds_sim.road_simulator import RoadSimulator
from ds_sim.simulator import Command
from ds_sim.testing import STRAIGHT, digest

CAMERA = parse_conditions("camera_pitch=3deg,camera_yaw=2deg,sensor_noise=5,lens_dirt=0.1,illuminance=400,payload=0.2")


def test_conditions_of_camera_and_car_are_realised_and_leave_no_trace() -> None:
    simulator = make_simulator("panda")
    assert isinstance(simulator, RoadSimulator) and set(CAMERA.changed) <= set(simulator.spec.conditions)

    def run(conditions: Conditions) -> str:
        frames = [simulator.load(STRAIGHT, seed=2, conditions=conditions)]
        for _ in range(3):
            frames.append(simulator.step(Command(0.1, 1.0)))
        return digest(frames)

    before, under = run(Conditions()), run(CAMERA)
    assert run(CAMERA) == under != before == run(Conditions())

    def horizon(conditions: Conditions) -> int:
        image = simulator.load(STRAIGHT, seed=2, conditions=conditions).image.astype(int)
        return int(np.argmax((image[..., 2] - image[..., 1]).mean(axis=1) < -5))

    camera, pitch = simulator.spec.camera, math.radians(5.0)
    focal = camera.intrinsics[0, 0]
    moved = focal * (math.tan(camera.pitch) - math.tan(camera.pitch + pitch))
    assert horizon(Conditions(camera_pitch=pitch)) - horizon(Conditions()) == pytest.approx(moved, abs=3)
    with pytest.raises(NotApplicableError, match="^panda cannot realise visibility: it realises illuminance, "):
        simulator.load(STRAIGHT, seed=2, conditions=Conditions(visibility=50.0))
    simulator.close()


def test_less_friction_lowers_the_grip_limit_and_load_costs_acceleration() -> None:
    simulator = make_simulator("panda")
    assert isinstance(simulator, RoadSimulator)
    vehicle, sideways, speeds = simulator.vehicle, [], []
    for friction, payload in ((1.0, 0.0), (0.2, 0.0), (1.0, 0.5)):
        vehicle.adjust(friction=friction, payload=payload)  # type: ignore[attr-defined]
        vehicle.reset(0.0, 0.0, 0.0, np.random.default_rng(1))
        largest = 0.0
        for step in range(160):
            vehicle.advance(Command(0.0 if step < 80 else 1.0, 1.0))
            state = vehicle.state()
            if step == 30:
                speeds.append(state.speed)
            if step > 110:
                largest = max(largest, abs(state.speed * state.yaw_rate))
        sideways.append(largest)
    simulator.close()
    assert sideways[1] < 1.25 * 0.2 * 1.05 * 9.81 < sideways[0]  # the published tyre's peak is 1.05
    assert speeds[2] < 0.85 * speeds[0]
