# SPDX-License-Identifier: Apache-2.0
"""The straight road seen from straight above, without anything beside it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache
from unittest import mock

import numpy as np
from numpy.typing import NDArray
from panda_views import STRAIGHT, pose

from ds_sim.camera.spec import CameraSpec
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim_panda.scene import world
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
    """Row of a survey that shows a position across the road."""
    return round((ROWS - 1) / 2 - (x - 125.0) / PIXEL)
