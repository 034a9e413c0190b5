# SPDX-License-Identifier: Apache-2.0
"""Images are those of a camera without short cuts: the whole world painted at once, and every row drawn on its own.

Simulators paint only what is looked at, draw rows in bands, reuse memory and leave out rows; none of it may change a
bit. `whole_atlas` is the former code, made as simple as possible.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from ds_road import Road, generate
from ds_sim.camera import ground as painting
from ds_sim.camera.atlas import AtlasMemory, textures
from ds_sim.camera.ground import paint_ground
from ds_sim.camera.rendered_scene import Sensor, scene_rows
from ds_sim.camera.renderer import Camera
from ds_sim.camera.spec import Look
from ds_sim.camera.surface import LEAD_IN, LEAD_OUT, RESOLUTION
from ds_sim.registry import STANDARD, spec_of
from ds_sim.simulator import VehicleState

ROADS = {
    "winding": generate(np.random.default_rng(1), max_angle=150),
    "few long segments": Road.from_road_points([(0.0, 0.0), (60.0, 5.0), (110.0, 70.0), (111.0, 130.0)]),
    "narrow": Road([(0, 0), (20, 10), (50, 10), (70, 30), (75, 60)], lane_width=1.5),
}


def whole_atlas(road: Road, look: Look) -> NDArray[np.uint8]:
    """All levels of the ground, painted in full, side by side."""
    centre, across = painting.with_leads(road, LEAD_IN, LEAD_OUT)
    half_width = road.lane_width
    low, high = centre.min(axis=0) - half_width - painting.MARGIN, centre.max(axis=0) + half_width + painting.MARGIN
    columns, rows = (math.ceil((high[i] - low[i]) / RESOLUTION / 32) * 32 for i in (0, 1))
    made = textures(look, painting.LEVELS)
    repeats = (math.ceil(rows / 512), math.ceil(columns / 512), 1)
    raster, asphalt = (
        np.ascontiguousarray(np.tile(t[..., :3], repeats)[:rows, :columns]) for t in (made.grass[0], made.asphalt)
    )
    for part in (slice(0, 2), slice(-2, None), slice(1, -1)):
        line, normal = centre[part] - low, across[part]

        def pixels(
            offset: float, line: NDArray[np.float64] = line, normal: NDArray[np.float64] = normal
        ) -> NDArray[np.int32]:
            return np.round(((line + offset * normal) / RESOLUTION - 0.5) * 64).astype(np.int32)

        mask = np.zeros((rows, columns), np.uint8)
        cv2.fillPoly(mask, [np.concatenate((pixels(half_width), pixels(-half_width)[::-1]))], 255, cv2.LINE_8, 6)
        raster[mask > 0] = asphalt[mask > 0]
        inset = half_width - look.line_width / 2
        for offset, colour in ((inset, look.edge_line), (-inset, look.edge_line), (0.0, look.centre_line)):
            thickness = max(1, round(look.line_width / RESOLUTION))
            cv2.polylines(raster, [pixels(offset)], False, colour, thickness, cv2.LINE_AA, 6)
    atlas = np.zeros((rows, 2 * columns, 4), np.uint8)
    outside = (*(int(round(v)) for v in made.grass[0][..., :3].reshape(-1, 3).mean(axis=0)), 255)
    start = 0
    for _ in range(painting.LEVELS):
        height, width = raster.shape[:2]
        atlas[:, start] = outside
        view = atlas[:height, start : start + width]
        view[..., :3] = raster
        view[0] = view[-1] = view[:, 0] = view[:, -1] = outside
        atlas[height : height + 1, start : start + width] = outside
        start += width
        raster = cv2.resize(raster, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    atlas[:, start:] = outside
    return atlas


def poses(road: Road, seed: int) -> Iterator[VehicleState]:
    """Poses along the lane, with all that moves a camera, and some anywhere in the painted world."""
    rng = np.random.default_rng(seed)
    lane = road.right_lane_centre
    for k in np.linspace(0, len(lane) - 2, 3).astype(int):
        yield _pose(rng, lane[k], math.atan2(*(lane[k + 1] - lane[k])[::-1]), 0.02)
    for _ in range(2):
        yield _pose(rng, rng.uniform(lane.min(axis=0) - 25.0, lane.max(axis=0) + 25.0), rng.uniform(-4.0, 4.0), 0.1)


def _pose(rng: np.random.Generator, place: NDArray[np.float64], yaw: float, tilt: float) -> VehicleState:
    x, y, turned = (float(v) for v in (*(place + rng.normal(0.0, 0.7, 2)), yaw + rng.normal(0.0, 0.3)))
    more = {
        name: float(rng.normal(0.0, size))
        for name, size in (("yaw_rate", 0.5), ("lateral_speed", 0.3), ("roll", tilt), ("pitch", tilt), ("heave", 0.02))
    }
    return VehicleState(x=x, y=y, yaw=turned, speed=float(rng.uniform(0, 8)), steering_angle=0.0, **more)


@cache
def memory() -> AtlasMemory:
    """One memory for all roads: what former roads left in it must not show."""
    return AtlasMemory()


@pytest.mark.parametrize("name", STANDARD)
@pytest.mark.parametrize("road", ROADS)
def test_short_cuts_change_no_bit(name: str, road: str) -> None:
    spec = spec_of(name)
    look, track = spec.look, ROADS[road]
    atlas, start = whole_atlas(track, look), 0
    whole = paint_ground(track, look)
    for level in whole.levels:  # which paints them in full
        height, width = level.shape[:2]
        assert np.array_equal(level[..., :3], atlas[:height, start : start + width, :3])
        start += width
    ground = paint_ground(track, look, memory())
    rows = (spec.crop_top + 7, 150)
    camera, partial = Camera(spec.camera, look), Camera(spec.camera, look, rows)
    lines = [(row, Camera(spec.camera, look, (row, row + 1))) for row in range(spec.crop_top, 160, 13)]
    for vehicle in poses(track, len(road)):
        # The other way round, what one camera has painted would hide what the other has not.
        part = partial.render(ground, vehicle)
        image = camera.render(ground, vehicle)
        assert all(np.array_equal(one.render(whole, vehicle)[row], image[row]) for row, one in lines)
        assert np.array_equal(part[slice(*rows)], image[slice(*rows)])
        assert not part[: rows[0]].any() and not part[rows[1] :].any()


@pytest.mark.parametrize("more", [{}, {"blur": 1.2}, {"noise": 80.0}, {"noise": 0.0, "latency": 2}])
@pytest.mark.parametrize("rows", [(0, 160), (54, 160), (33, 34)])
def test_a_sensor_delivers_the_same_rows(more: dict[str, float], rows: tuple[int, int]) -> None:
    spec = replace(spec_of("donkey").camera, **more)  # type: ignore[arg-type]
    whole, part = (Sensor(spec, np.random.default_rng(5), r) for r in (None, rows))
    first, last = scene_rows(spec, rows)
    rng = np.random.default_rng(6)
    for _ in range(4):
        scene = cv2.resize(rng.integers(0, 256, (40, 80, 3), np.uint8), (320, 160))
        cut = np.zeros_like(scene)
        cut[first:last] = scene[first:last]
        expected, delivered = whole.deliver(np.asarray(scene, np.uint8)), part.deliver(cut)
        assert np.array_equal(delivered[slice(*rows)], expected[slice(*rows)])
        assert not delivered[: rows[0]].any() and not delivered[rows[1] :].any()


def test_noise_saturates_at_black_and_white() -> None:
    """Against signed noise, added without overflow and clipped."""
    spec = replace(spec_of("bullet").camera, noise=90.0)
    sensor, rng = Sensor(spec, np.random.default_rng(7)), np.random.default_rng(7)
    plate = rng.normal(0.0, 1.0, (spec.height_px + 64, spec.width + 64, 3))
    plate = np.round(plate * (90.0 / plate.std()))
    for value in (3, 128, 250):
        row, column = rng.integers(0, 64, 2)
        expected = value + plate[row : row + spec.height_px, column : column + spec.width]
        scene = np.full((spec.height_px, spec.width, 3), value, np.uint8)
        assert np.array_equal(sensor.deliver(scene), expected.clip(0, 255))
