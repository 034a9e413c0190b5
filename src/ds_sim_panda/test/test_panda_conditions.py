# SPDX-License-Identifier: Apache-2.0
"""Conditions of camera, sensor and car on the simulator `panda`."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from panda_views import CAMERA, STRAIGHT, pose, project

from ds_sim.conditions.model import Conditions
from ds_sim.registry import make_simulator
from ds_sim.road_simulator import RoadSimulator
from ds_sim.simulator import Command
from ds_sim_panda.simulator import PandaScene


def test_a_tilted_turned_and_raised_camera_sees_what_it_should() -> None:
    """The centre line is where an independent projection puts it; the horizon moves by the right rows."""
    vehicle, line = pose(127.0, 60.0, math.pi / 2), np.column_stack((np.full(900, 125.0), np.linspace(62.0, 80.0, 900)))
    scene = PandaScene(CAMERA)

    def image(conditions: Conditions) -> NDArray[np.int64]:
        scene.load(STRAIGHT, np.random.default_rng(1), conditions)
        return scene.still(vehicle, np.random.default_rng(1)).astype(int)

    for conditions in (Conditions(camera_yaw=-0.12), Conditions(camera_height=1.6), Conditions(camera_pitch=0.08)):
        yaw, c = conditions.camera_yaw, conditions
        camera = replace(CAMERA, height=CAMERA.height * c.camera_height, pitch=CAMERA.pitch + c.camera_pitch)
        # Turning the camera is turning the car, whose centre is then elsewhere.
        turned = pose(127.0 + 0.3 * math.sin(yaw), 60.3 - 0.3 * math.cos(yaw), vehicle.yaw + yaw)
        seen = project(camera, turned, np.column_stack((line, np.zeros(len(line)))))
        yellow, checked = (lambda i: i[..., 0] - i[..., 2])(image(conditions)), 0
        for row in range(100, 150, 7):
            expected = float(np.interp(row, seen[::-1, 1], seen[::-1, 0]))
            if 8 < expected < 312:
                near = yellow[row, round(expected) - 8 : round(expected) + 9].clip(40) - 40
                centre = round(expected) - 8 + (near * np.arange(17)).sum() / near.sum()
                assert centre == pytest.approx(expected, abs=1.0)
                checked += 1
        assert checked >= 4

    def horizon(conditions: Conditions) -> int:
        return int(np.argmax((image(conditions)[..., 2] - image(conditions)[..., 1]).mean(axis=1) < -5))

    pitch, focal = math.radians(5.0), CAMERA.intrinsics[0, 0]
    moved = focal * (math.tan(CAMERA.pitch) - math.tan(CAMERA.pitch + pitch))
    assert horizon(Conditions(camera_pitch=pitch)) - horizon(Conditions()) == pytest.approx(moved, abs=3)


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
