# SPDX-License-Identifier: Apache-2.0
"""Shadows of the sun on the ground: everything flattened along the sun's rays, drawn once for each road."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_sim_panda.scene.along_road import AlongRoad
from ds_sim_panda.scene.graphics import graphics, panda
from ds_sim_panda.scene.meshes import Course, mesh_node, road_strip
from ds_sim_panda.scene.parameters import SHADE_REACH, SHADE_SLANT, SHADOW_MARGIN, SHADOW_PIXELS, VERGE_WIDTH
from ds_sim_panda.scene.setting import Direction
from ds_sim_panda.scene.shaders import shader
from ds_sim_panda.scene.textures import patches, upload

_BORDER = 8
"""Pixels at the map's border without shadow, as what is there goes on beyond it; chosen."""


def cast_shadows(
    solids: Any, course: Course, towards_sun: Direction, along: AlongRoad | None = None
) -> tuple[Any, tuple[float, float, float]]:
    """Draw the shadows around a road, seen from above: of solids, a `NodePath`, and those that conditions put along it.

    The solids have no parent afterwards.

    Returns:
        Texture, 1 in full shadow of what stands beside the road, and in a second channel, if any, in one of conditions;
        x and y of its corner, m, and its scale, 1/m.
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
    root.set_depth_test(False, 1)
    root.set_two_sided(True, 1)
    layers = []
    sun = np.array(towards_sun)
    along_rays = (-sun / sun[2]).tolist()
    flat = root.attach_new_node("flat")
    flat.set_mat(core.LMatrix4(1, 0, 0, 0, 0, 1, 0, 0, along_rays[0], along_rays[1], 0, 0, 0, 0, 0, 1))
    solids.reparent_to(flat)
    flat.set_shader(shader("flat"), 1)
    layers.append(_map_of(camera))
    solids.detach_node()
    if along is not None:
        strips = root.attach_new_node(_strips(course, towards_sun))
        strips.set_shader(shader("shade"), 1)
        strips.set_shader_input("shaded", along.shaded)
        strips.set_shader_input("road_frame", core.LVector2(*along.frame))
        strips.set_shader_input("patches", patches())
        layers.append(_map_of(camera))
    image = layers[0] if len(layers) == 1 else np.dstack(layers)
    return upload("shadows", image, wrap=False), (float(low[0]), float(low[1]), 1.0 / side)


def _map_of(camera: Any) -> NDArray[np.uint8]:
    """Draw what a camera above sees, (SHADOW_PIXELS, SHADOW_PIXELS)."""
    drawn = graphics().draw(camera, SHADOW_PIXELS, SHADOW_PIXELS, samples=0)[..., 0]
    # The sun is half a degree wide: the shadow of what is 10 m high has a border of 0.14 m.
    soft = np.asarray(cv2.blur(np.ascontiguousarray(drawn), (3, 3)), np.uint8)
    for border in (soft[:_BORDER], soft[-_BORDER:], soft[:, :_BORDER], soft[:, -_BORDER:]):
        border[:] = 0
    return soft


def _strips(course: Course, towards_sun: Direction) -> Any:
    """Panda3D's node of strips beside and, over them, on the road, whose coordinates follow the shadows' direction."""
    sun = np.array(towards_sun[:2]) / max(math.hypot(*towards_sun[:2]), 1e-9)
    right_x, right_y = course.right.T
    across, ahead = right_x * sun[0] + right_y * sun[1], right_x * sun[1] - right_y * sun[0]
    slant = ahead * across / (across**2 + SHADE_SLANT)
    border = course.half_width + VERGE_WIDTH
    meshes = [
        road_strip(course, offsets)
        for offsets in ((-border - SHADE_REACH, -border), (border, border + SHADE_REACH), (-border, border))
    ]
    vertices = np.concatenate([mesh[0] for mesh in meshes])
    vertices["texture"][:, 1] -= np.tile(np.repeat(slant, 2), len(meshes)) * vertices["texture"][:, 0]
    triangles = np.concatenate([mesh[1] + i * len(meshes[0][0]) for i, mesh in enumerate(meshes)])
    return mesh_node("shade", vertices, triangles)
