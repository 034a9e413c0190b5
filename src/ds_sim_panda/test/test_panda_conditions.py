# SPDX-License-Identifier: Apache-2.0
"""Conditions of `panda`: world and camera in pictures from straight above or by an independent projection, and car."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from unittest import mock

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from panda_views import CAMERA, STRAIGHT, pose, project

from ds_sim.camera.spec import CameraSpec
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.registry import make_simulator
from ds_sim.road_simulator import RoadSimulator
from ds_sim.simulator import Command, VehicleState
from ds_sim_panda.scene import world
from ds_sim_panda.scene.along_road import repaired
from ds_sim_panda.scene.meshes import course_of
from ds_sim_panda.scene.parameters import HORIZON, VISIBILITY
from ds_sim_panda.scene.scenery import Things
from ds_sim_panda.simulator import PandaScene

PIXEL = 0.05
"""Size of a pixel on the ground, m."""
ROWS = 240
"""12 m across the road."""
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)
_LIGHT = np.square(np.arange(256, dtype=np.float32) / 255.0)
NOTHING: Mapping[str, Things] = {}


def picture(
    height: float, conditions: Conditions = DEFAULT, *, seed: int = 1, scenery: Mapping[str, Things] = NOTHING
) -> NDArray[np.float32]:
    """Linear picture from above the middle of the road, which spans twice the height along it, (ROWS, columns, 3)."""
    columns = round(2 * height / PIXEL)
    camera = CameraSpec(
        horizontal_fov=math.radians(90.0), height=height, pitch=math.radians(90.0), width=columns, height_px=ROWS
    )
    scene = PandaScene(camera)
    with mock.patch.object(world, "place_scenery", return_value=scenery):
        scene.load(STRAIGHT, np.random.default_rng(seed), conditions)
    return _LIGHT[scene.still(pose(125.0, 100.0, 0.0), np.random.default_rng(1))]


def distances(height: float) -> NDArray[np.float32]:
    """Distance from the camera to the ground at each pixel, m, (ROWS, columns)."""
    columns = round(2 * height / PIXEL)
    along = (np.arange(columns) - (columns - 1) / 2) * PIXEL
    across = (np.arange(ROWS) - (ROWS - 1) / 2) * PIXEL
    return np.sqrt(along[None] ** 2 + across[:, None] ** 2 + height**2).astype(np.float32)


@cache
def survey(conditions: Conditions = DEFAULT, *, seed: int = 1) -> NDArray[np.float32]:
    """Light of the ground from y = 175 m (left) to 25 m, all of the road's length, without haze, (ROWS, 3000, 3)."""
    arrived = np.exp(-3.912 * distances(75.0) / VISIBILITY)[..., None]
    scattered = (1.0 - arrived) * np.array(HORIZON, np.float32)
    return np.asarray((picture(75.0, conditions, seed=seed) - scattered) / arrived)


def row_of(x: float) -> int:
    return round((ROWS - 1) / 2 - (x - 125.0) / PIXEL)


LINES = (125.0 - 3.925, 125.0, 125.0 + 3.925)
"""Middle of each line across the road, m."""
LANES = [*range(row_of(128.7), row_of(125.3)), *range(row_of(124.7), row_of(121.3))]
"""Rows between the lines."""


def line_light(surveyed: NDArray[np.float32], x: float) -> NDArray[np.float32]:
    """Contrast of a line in its red light against the pavement beside it, along the road."""
    row, beside = row_of(x), row_of(x + (0.5 if x < 126.0 else -0.5))
    return np.asarray(surveyed[row, :, 0] - surveyed[beside - 3 : beside + 4, :, 0].mean(axis=0))


def still(vehicle: VehicleState, conditions: Conditions) -> NDArray[np.uint8]:
    scene = PandaScene(CAMERA)
    scene.load(STRAIGHT, np.random.default_rng(1), conditions)
    return scene.still(vehicle, np.random.default_rng(1))


def test_as_much_of_each_line_is_bare_as_is_claimed() -> None:
    before = np.zeros((3, 3000), bool)
    for share in (0.25, 0.6):
        surveyed = survey(Conditions(line_cover=share, line_cover_length=3.0))
        bare = np.array([line_light(surveyed, x) < 0.1 for x in LINES])
        assert bare.mean(axis=1) == pytest.approx(share, abs=0.015)
        for line in bare:
            edges = np.flatnonzero(np.diff(line))
            assert len(edges) > 10 and np.diff(edges).min() * PIXEL > 0.5  # pieces, not specks
        assert np.mean(before & ~bare) < 0.001  # what is bare stays bare
        before = bare
    assert not np.array_equal(bare[0], bare[2])
    other = survey(Conditions(line_cover=0.6, line_cover_length=3.0), seed=2)
    assert np.mean((line_light(other, 125.0) < 0.1) != bare[1]) > 0.2


def test_as_much_contrast_of_the_paint_is_left_as_is_claimed() -> None:
    new = survey()
    for contrast in (0.6, 0.0):
        worn = survey(Conditions(line_contrast=contrast))
        for x in LINES:
            expected = contrast * line_light(new, x).mean()
            assert line_light(worn, x).mean() == pytest.approx(expected, rel=0.05, abs=0.006)


def test_shadows_cover_their_share_and_take_their_part_of_the_light() -> None:
    clear, before = survey() @ LUMINANCE, np.zeros((240, 3000), bool)
    for density, depth in ((0.2, 0.6), (0.6, 0.6), (0.5, 0.9)):
        left = survey(Conditions(shadow_density=density, shadow_depth=depth)) @ LUMINANCE / clear
        for x in (120.0, 122.5, 127.5, 130.5):  # the verges and either lane
            strip = left[row_of(x) - 3 : row_of(x) + 4].mean(axis=0)
            assert np.mean(strip < 1.0 - depth / 2) == pytest.approx(density, abs=0.04)
            assert np.quantile(strip, 0.1) == pytest.approx(1.0 - depth, rel=0.05, abs=0.01)
        if depth == 0.6:
            shaded = left < 0.6
            assert np.mean(before & ~shaded) < 0.002
            before = shaded


def test_patches_cover_their_share() -> None:
    clear, before = survey() @ LUMINANCE, np.zeros(1)
    for share in (0.2, 0.5):
        patched = (survey(Conditions(repair_share=share)) @ LUMINANCE / clear)[LANES] < 0.8
        assert patched.mean() == pytest.approx(share, abs=0.02)
        assert np.mean(before * ~patched) < 0.002
        before = patched.astype(float)


def test_patches_differ_in_size_place_and_direction() -> None:
    """At a small share hardly any two overlap."""
    texel = 0.125
    mask = repaired(np.random.default_rng(4), 2000.0, 8.0, 0.05, (64, 16_000))
    count, _, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    boxes = stats[1:][stats[1:, cv2.CC_STAT_AREA] > 30] * texel
    lengths, widths = boxes[:, cv2.CC_STAT_WIDTH], boxes[:, cv2.CC_STAT_HEIGHT]
    assert count > 50
    assert np.ptp(np.quantile(lengths, (0.1, 0.9))) > 2.0 and np.ptp(np.quantile(widths, (0.1, 0.9))) > 1.0
    assert 0.05 < np.mean(widths > 2.0 * lengths) < 0.4  # some lie across the road
    filled = stats[1:, cv2.CC_STAT_AREA] / (stats[1:, cv2.CC_STAT_WIDTH] * stats[1:, cv2.CC_STAT_HEIGHT])
    assert np.mean(filled < 0.95) > 0.3  # not exactly along the road
    starts = boxes[:, cv2.CC_STAT_TOP]
    assert len(np.unique(np.round(starts[(starts > 0.0) & (starts < 8.0)] / texel))) > 20
    other = repaired(np.random.default_rng(5), 2000.0, 8.0, 0.05, (64, 16_000))
    assert np.mean(other & mask) < 0.01


def test_pavement_has_the_reflectance_that_is_claimed() -> None:
    for reflectance in (0.05, 0.35):
        surveyed = survey(Conditions(pavement_reflectance=reflectance)) @ LUMINANCE
        assert surveyed[LANES].mean() == pytest.approx(reflectance, rel=0.05)


def test_contrast_falls_with_distance_as_koschmieder_says() -> None:
    visibility = 40.0
    for height in (10.0, 20.0):
        clear, hazy = (line_light(picture(height, Conditions(visibility=v)), 125.0) for v in (math.inf, visibility))
        distance = distances(height)[row_of(125.0)]
        expected = np.exp(-3.912 * distance * (1.0 / visibility - 1.0 / VISIBILITY))
        for part in np.array_split(np.arange(len(clear)), 8):
            assert hazy[part].mean() == pytest.approx((expected * clear)[part].mean(), rel=0.04, abs=0.004)


def test_a_shadow_falls_away_from_the_sun_of_the_conditions() -> None:
    azimuth, elevation, tall = math.radians(60.0), math.radians(35.0), 4.0
    foot = np.array([128.0, 100.0])
    position, size = foot - course_of(STRAIGHT).origin, (0.3, 0.3, tall)
    mast = {"post": Things(position[None], np.array([size]), np.zeros(1), np.ones(1))}
    conditions = Conditions(sun_azimuth=azimuth, sun_elevation=elevation)
    left = np.divide(*(picture(20.0, conditions, scenery=scenery) @ LUMINANCE for scenery in (mast, {})))
    away = -np.array([math.cos(azimuth), math.sin(azimuth)])
    for share, shaded in ((0.6, True), (0.9, True), (1.15, False)):
        x, y = foot + share * tall / math.tan(elevation) * away
        value = left[row_of(x), round(399.5 - (y - 100.0) / PIXEL)]
        assert value < 0.4 if shaded else value == pytest.approx(1.0, abs=0.03)


def test_the_low_sun_is_where_it_stands() -> None:
    azimuth, elevation, vehicle = math.pi / 2 - 0.3, 0.15, pose(127.0, 60.0, math.pi / 2)
    dim = Conditions(sun_azimuth=azimuth, sun_elevation=elevation)
    images = [still(vehicle, one).astype(float).sum(axis=2) for one in (dim, replace(dim, low_sun=1000.0))]
    far = 1e5 * np.array([math.cos(azimuth), math.sin(azimuth), math.tan(elevation)])
    column, row, _ = project(CAMERA, vehicle, far[None])[0]
    rows, columns = np.nonzero(images[1] >= 3 * 254)
    assert (columns.mean(), rows.mean()) == pytest.approx((column, row), abs=2.0)
    assert (images[1] >= images[0] - 3).all()


def test_a_tilted_turned_and_raised_camera_sees_what_it_should() -> None:
    """The centre line is where an independent projection puts it; the horizon moves by the right rows."""
    vehicle, line = pose(127.0, 60.0, math.pi / 2), np.column_stack((np.full(900, 125.0), np.linspace(62.0, 80.0, 900)))

    def image(conditions: Conditions) -> NDArray[np.int64]:
        return still(vehicle, conditions).astype(int)

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
