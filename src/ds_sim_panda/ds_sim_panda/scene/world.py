# SPDX-License-Identifier: Apache-2.0
"""Scene graph of one road: ground, road, sky, and what stands beside the road."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np

from ds_road import Road
from ds_sim_panda.scene import textures
from ds_sim_panda.scene.along_road import AlongRoad, along_road
from ds_sim_panda.scene.graphics import panda
from ds_sim_panda.scene.meshes import Course, course_of, ground_rings, mesh_node, road_strip
from ds_sim_panda.scene.parameters import VERGE_WIDTH
from ds_sim_panda.scene.scenery import place_scenery
from ds_sim_panda.scene.setting import Setting, own_daylight
from ds_sim_panda.scene.shaders import shader
from ds_sim_panda.scene.shadows import cast_shadows
from ds_sim_panda.scene.sky import sky_dome, sky_texture
from ds_sim_panda.scene.solids import solid_meshes

FILTER = 0.3
"""Width of road and verge beyond their borders, in which these fade into what is below, m; chosen: a pixel is wider
only beyond 50 m."""


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
