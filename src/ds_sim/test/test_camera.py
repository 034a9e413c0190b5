# SPDX-License-Identifier: Apache-2.0
"""Compares the camera with an independent projection of points; tests horizon and sensor."""

from __future__ import annotations

import math
from typing import Literal

import cv2
import numpy as np
import pytest
from camera_reference import ground_of
from scipy.spatial.transform import Rotation

from ds_sim.camera.atlas import Ground
from ds_sim.camera.look import Look
from ds_sim.camera.renderer import Camera
from ds_sim.camera.sensor import Sensor
from ds_sim.camera.spec import CameraSpec
from ds_sim.simulator import VehicleState

Lens = Literal["pinhole", "equidistant"]
LOOK = Look(asphalt=(90, 90, 95), grass=(90, 140, 70))


def pose(x: float, y: float, yaw: float, roll: float = 0.0, pitch: float = 0.0, heave: float = 0.0) -> VehicleState:
    return VehicleState(
        x=x, y=y, yaw=yaw, speed=0.0, yaw_rate=0.0, steering_angle=0.0, roll=roll, pitch=pitch, heave=heave
    )


def project(spec: CameraSpec, vehicle: VehicleState, point: tuple[float, float]) -> tuple[float, float]:
    """Image position of a point on the ground, by SciPy's rotations and the textbook formula of the lens."""
    body = Rotation.from_euler("ZYX", [vehicle.yaw, vehicle.pitch, vehicle.roll])
    camera = np.array([vehicle.x, vehicle.y, vehicle.heave]) + body.apply([spec.forward, 0.0, spec.height])
    mount = body * Rotation.from_euler("Y", spec.pitch)
    forward, left, up = mount.inv().apply(np.array([*point, 0.0]) - camera)
    k = spec.intrinsics
    if spec.lens == "equidistant":
        angle = math.atan2(math.hypot(left, up), forward)
        radius = angle / math.hypot(left, up)
        return k[0, 2] - k[0, 0] * radius * left, k[1, 2] - k[1, 1] * radius * up
    return k[0, 2] - k[0, 0] * left / forward, k[1, 2] - k[1, 1] * up / forward


def spotted_ground(point: tuple[float, float]) -> Ground:
    """Grey plane with one white square of 0.4 m around a point."""
    size, resolution = 1200, 0.05
    raster = np.full((size, size, 3), 60, np.uint8)
    column, row = round(point[0] / resolution), round(point[1] / resolution)
    raster[row - 4 : row + 4, column - 4 : column + 4] = 255
    levels = [raster]
    for _ in range(5):
        levels.append(cv2.resize(levels[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
    return ground_of(levels, (60, 60, 60))


@pytest.mark.parametrize("lens", ["pinhole", "equidistant"])
@pytest.mark.parametrize(
    ("yaw", "roll", "pitch", "heave"),
    [(0.0, 0.0, 0.0, 0.0), (0.5, 0.0, 0.05, 0.0), (1.2, 0.08, 0.0, 0.1), (-0.7, -0.1, -0.04, -0.05)],
)
@pytest.mark.parametrize("ahead", [(6.0, 0.6), (9.0, -2.0), (14.0, 3.0)])
def test_a_spot_on_the_ground_is_projected_correctly(
    lens: Literal["pinhole", "equidistant"],
    yaw: float,
    roll: float,
    pitch: float,
    heave: float,
    ahead: tuple[float, float],
) -> None:
    spec = CameraSpec(horizontal_fov=math.radians(100), height=1.4, forward=0.6, pitch=0.06, lens=lens)
    vehicle = pose(20.0, 30.0, yaw, roll, pitch, heave)
    rotation = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
    x, y = np.round((rotation @ ahead + (20.0, 30.0)) / 0.05) * 0.05
    frame = Camera(spec, LOOK).render(spotted_ground((x, y)), vehicle)[..., 1].astype(float)
    u, v = project(spec, vehicle, (x, y))
    near = frame[max(round(v) - 8, 0) : round(v) + 9, max(round(u) - 14, 0) : round(u) + 15] - 60.0
    near[near < 15.0] = 0.0
    rows, columns = np.indices(near.shape)
    found_u = (near * columns).sum() / near.sum() + max(round(u) - 14, 0)
    found_v = (near * rows).sum() / near.sum() + max(round(v) - 8, 0)
    assert found_u == pytest.approx(u, abs=0.5) and found_v == pytest.approx(v, abs=0.5)


def test_sensor_images_are_seeded_delayed_and_read_only() -> None:
    spec = CameraSpec(horizontal_fov=1.5, height=1.4, noise=4.0, latency=2)
    scenes = [np.full((160, 320, 3), value, np.uint8) for value in (50, 100, 150, 200)]

    def images(seed: int) -> list[np.ndarray]:
        sensor = Sensor(spec, np.random.default_rng(seed))
        return [sensor.deliver(scene) for scene in scenes]

    first, again, other = images(1), images(1), images(2)
    assert [round(float(i.mean()) / 50) * 50 for i in first] == [50, 50, 50, 100]
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not np.array_equal(first[0], other[0])
    assert first[3].std() == pytest.approx(4.0, rel=0.1)
    assert not first[0].flags.writeable
