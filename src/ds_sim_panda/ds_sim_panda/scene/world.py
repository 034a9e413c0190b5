# SPDX-License-Identifier: Apache-2.0
"""Scene graph of one road: ground, road, sky, what stands beside the road, and the shadows of it."""

from __future__ import annotations

import hashlib
import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_road import Road
from ds_sim_panda.scene import textures
from ds_sim_panda.scene.along_road import AlongRoad, along_road
from ds_sim_panda.scene.graphics import graphics, panda
from ds_sim_panda.scene.meshes import Course, course_of, ground_rings, mesh_node, road_strip
from ds_sim_panda.scene.parameters import SHADE_REACH, SHADE_SLANT, SHADOW_MARGIN, SHADOW_PIXELS, VERGE_WIDTH
from ds_sim_panda.scene.scenery import place_scenery
from ds_sim_panda.scene.setting import Direction, Setting, own_daylight
from ds_sim_panda.scene.shaders import shader
from ds_sim_panda.scene.sky import sky_dome, sky_texture
from ds_sim_panda.scene.solids import solid_meshes

FILTER = 0.3
"""Width of road and verge beyond their borders, in which these fade into what is below, m; chosen: a pixel is wider
only beyond 50 m."""
_BORDER = 8
"""Pixels at the map of shadows' border without one, as what is there goes on beyond it; chosen."""


def _seed_of(road: Road) -> int:
    """Seed of what stands beside a road: the same for equal centre lines, however described, and in either lane."""
    millimetres = np.round(1000.0 * road.points).astype("<i8")
    return int.from_bytes(hashlib.sha256(millimetres.tobytes()).digest()[:8], "little")


class World:
    """World of a road in Panda3D's scene graph, with what a setting changes; None in this world's own.

    Everything on the ground is drawn over what was drawn before it, without a depth test: nothing on a plane hides
    anything on it, and no two surfaces fight for a pixel.
    """

    def __init__(self, road: Road, setting: Setting | None = None) -> None:
        core = panda()
        course = course_of(road)
        daylight = setting.daylight if setting else own_daylight()
        along = along_road(course, setting.conditions, setting.rng) if setting else None
        self._changed = setting is not None
        self.origin = course.origin
        self.root = core.NodePath("world")
        self._sky = self._surface(sky_dome(), "sky", 0, sky=sky_texture(setting.sky if setting else daylight))
        border = course.half_width + FILTER
        # The triangles of the road itself, so that samples which it misses at their borders are not hidden either.
        hiding = self._surface(mesh_node("hiding", *road_strip(course, (-border, 0.0, border))), "hiding", 0)
        hiding.set_attrib(core.ColorWriteAttrib.make(core.ColorWriteAttrib.C_off))
        hiding.set_depth_test(True)
        hiding.set_depth_write(True)
        self._ground = self._surface(ground_rings(far=False), "ground", 1, grass=textures.grass())
        self._ground.set_depth_test(True)
        far = self._surface(ground_rings(far=True), "far ground", 1, grass=textures.grass())
        far.set_attrib(_blended())
        far.reparent_to(self._ground)
        self._road_surfaces(course, along)
        solids = core.NodePath(solid_meshes(place_scenery(course, _seed_of(road)), daylight))
        shadowed = along if setting and setting.conditions.shadow_density else None
        shadows, frame = cast_shadows(solids, course, daylight.towards_sun, shadowed)
        self.root.set_shader_input("shadows", shadows)
        self.root.set_shader_input("shadow_frame", core.LVector3(*frame))
        self.root.set_shader_input("patches", textures.patches())
        for name, value in (setting.shader_inputs() if setting else {}).items():
            self.root.set_shader_input(name, value if isinstance(value, float) else core.LVector3(*value))
        solids.set_shader(shader("solid", setting=self._changed))
        solids.set_shader_input("materials", textures.materials())
        solids.reparent_to(self.root)
        # The other surfaces have no borders but blended ones. The sky, drawn first, has it as well, as Panda3D takes
        # it for switched off before it is switched on for the first time, and OpenGL does not.
        for path in (self._sky, solids):
            path.set_antialias(core.AntialiasAttrib.M_multisample)

    def follow(self, x: float, y: float, z: float) -> None:
        """Move the sky to the camera and the ground below it; coordinates relative to `origin`, m."""
        self._sky.set_pos(x, y, z)
        self._ground.set_pos(x, y, 0.0)

    def _road_surfaces(self, course: Course, along: AlongRoad | None) -> None:
        border = course.half_width
        outer, inner = border + VERGE_WIDTH + FILTER, border - FILTER
        for name, offsets, sort, texture in (
            ("verge", (-outer, -inner), 2, {"gravel": textures.gravel()}),
            ("verge", (inner, outer), 2, {"gravel": textures.gravel()}),
            ("road", (-border - FILTER, 0.0, border + FILTER), 3, {"asphalt": textures.asphalt()}),
        ):
            strip = self._surface(mesh_node(name, *road_strip(course, offsets)), name, sort, **texture)
            strip.set_shader_input("half_width", course.half_width)
            strip.set_attrib(_blended())
        strip.set_shader_input("two_lanes", float(course.two_lanes))
        if along:
            strip.set_shader_input("bare", along.bare)
            strip.set_shader_input("repaired", along.repaired)
            strip.set_shader_input("road_frame", panda().LVector2(*along.frame))

    def _surface(self, node: Any, kind: str, sort: int, **inputs: Any) -> Any:
        """Attach a surface that is drawn in the order of `sort`, without depth."""
        path = self.root.attach_new_node(node)
        path.set_shader(shader(kind, setting=self._changed))
        for name, value in inputs.items():
            path.set_shader_input(name, value)
        path.set_bin("background", sort)
        path.set_depth_test(False)
        path.set_depth_write(False)
        path.set_two_sided(True)
        # Culling needs no bounds: every surface is in view.
        path.node().set_bounds(panda().OmniBoundingVolume())
        path.node().set_final(True)
        return path


def _blended() -> Any:
    """Attribute of surfaces that fade into what was drawn before them."""
    blend = panda().ColorBlendAttrib
    return blend.make(blend.M_add, blend.O_incoming_alpha, blend.O_one_minus_incoming_alpha)


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
        strips.set_shader_input("patches", textures.patches())
        layers.append(_map_of(camera))
    image = layers[0] if len(layers) == 1 else np.dstack(layers)
    return textures.upload("shadows", image, wrap=False), (float(low[0]), float(low[1]), 1.0 / side)


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
