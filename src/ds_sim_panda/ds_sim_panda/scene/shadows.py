"""Shadows of the sun on the ground: everything flattened along the sun's rays, drawn once for each road."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from ds_sim_panda.scene.graphics import graphics, panda
from ds_sim_panda.scene.parameters import SHADOW_MARGIN, SHADOW_PIXELS
from ds_sim_panda.scene.road_mesh import Course
from ds_sim_panda.scene.shaders import shader
from ds_sim_panda.scene.sunlight import sun_direction
from ds_sim_panda.scene.textures import upload

_BORDER = 8
"""Pixels at the map's border without shadow, as what is there goes on beyond it; chosen."""


@dataclass(frozen=True)
class Shadows:
    """Map of shadows.

    Attributes:
        texture: 1 in full shadow.
        frame: x and y of its corner, m, and its scale, 1/m.
    """

    texture: Any
    frame: tuple[float, float, float]


def cast_shadows(solids: Any, course: Course) -> Shadows:
    """Draw the shadows around a road, seen from above.

    Args:
        solids: `NodePath` of all that casts shadows; it has no parent afterwards.
        course: the road.
    """
    core = panda()
    low, high = course.points.min(axis=0) - SHADOW_MARGIN, course.points.max(axis=0) + SHADOW_MARGIN
    side = float((high - low).max())
    lens = core.OrthographicLens()
    lens.set_film_size(side, side)
    lens.set_near_far(1.0, 20.0)
    root = core.NodePath("shadows")
    camera = root.attach_new_node(core.Camera("above", lens))
    x, y = (low + side / 2).tolist()
    camera.set_mat(core.LMatrix4(1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, x, y, 10, 1))
    sun = sun_direction()
    along_rays = (-sun / sun[2]).tolist()
    flat = root.attach_new_node("flat")
    flat.set_mat(core.LMatrix4(1, 0, 0, 0, 0, 1, 0, 0, along_rays[0], along_rays[1], 0, 0, 0, 0, 0, 1))
    solids.reparent_to(flat)
    root.set_shader(shader("flat"), 1)
    root.set_depth_test(False, 1)
    root.set_two_sided(True, 1)
    drawn = graphics().draw(camera, SHADOW_PIXELS, SHADOW_PIXELS, samples=0)[..., 0]
    solids.detach_node()
    # The sun is half a degree wide: the shadow of what is 10 m high has a border of 0.14 m.
    soft = cv2.blur(np.ascontiguousarray(drawn), (3, 3))
    for border in (soft[:_BORDER], soft[-_BORDER:], soft[:, :_BORDER], soft[:, -_BORDER:]):
        border[:] = 0
    return Shadows(upload("shadows", soft, wrap=False), (float(low[0]), float(low[1]), 1.0 / side))
