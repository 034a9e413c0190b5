# SPDX-License-Identifier: Apache-2.0
"""Scene graph of one road: ground, road, what stands beside it and its shadows, under a dome of sky with clouds."""

from __future__ import annotations

import hashlib
import math
from functools import cache, lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_road import Road
from ds_sim_panda.scene import parameters, textures
from ds_sim_panda.scene.along_road import AlongRoad, along_road
from ds_sim_panda.scene.graphics import graphics, panda
from ds_sim_panda.scene.meshes import VERTEX, Course, course_of, ground_rings, mesh_node, road_strip, strip_triangles
from ds_sim_panda.scene.parameters import SHADE_REACH, SHADE_SLANT, SHADOW_MARGIN, SHADOW_PIXELS, VERGE_WIDTH
from ds_sim_panda.scene.scenery import place_scenery
from ds_sim_panda.scene.setting import Daylight, Direction, Setting, own_daylight
from ds_sim_panda.scene.shaders import shader
from ds_sim_panda.scene.solids import solid_meshes
from ds_sim_panda.scene.textures import noise, stored, upload

LOWEST, HIGHEST = math.radians(-4.0), math.radians(56.0)
"""Elevations between which the sky is painted; above, its last row goes on."""
ROWS, COLUMNS = 160, 1024
CLOUD_BASE = 0.12
"""Flattens the clouds' plane, so that they do not shrink to nothing at the horizon; chosen."""
FILTER = 0.3
"""Width of road and verge beyond their borders, in which these fade into what is below, m; chosen: a pixel is wider
only beyond 50 m."""
_BORDER = 8
"""Pixels at the map of shadows' border without one, as what is there goes on beyond it; chosen."""


@lru_cache(maxsize=2)
def sky_texture(daylight: Daylight) -> Any:
    """Panorama of the sky, all azimuths by elevations from `LOWEST` to `HIGHEST`."""
    return upload("sky", stored(sky_colours(daylight)), wrap=False)


def sky_colours(daylight: Daylight) -> NDArray[np.float64]:
    """Linear colours of the panorama, (ROWS, COLUMNS, 3); columns run counter-clockwise from +x."""
    elevation = LOWEST + (np.arange(ROWS) + 0.5) / ROWS * (HIGHEST - LOWEST)
    azimuth = (np.arange(COLUMNS) + 0.5) / COLUMNS * math.tau
    height = np.clip(elevation / parameters.ZENITH_ELEVATION, 0.0, 1.0)[:, None, None]
    share = (1.0 - height) ** 3.0
    sky = np.broadcast_to(share * parameters.HORIZON + (1.0 - share) * parameters.ZENITH, (ROWS, COLUMNS, 3)).copy()
    sun = daylight.towards_sun
    towards = np.cos(elevation)[:, None] * (np.cos(azimuth) * sun[0] + np.sin(azimuth) * sun[1])
    towards += np.sin(elevation)[:, None] * sun[2]
    sky *= (1.0 + 0.35 * np.clip(towards, 0.0, 1.0) ** 3)[..., None]
    _add_clouds(sky, elevation, azimuth)
    _add_skyline(sky, elevation, daylight)
    return sky


def _add_clouds(sky: NDArray[np.float64], elevation: NDArray[np.float64], azimuth: NDArray[np.float64]) -> None:
    """Clouds lie on a plane overhead; light from the sun's side, grey at their base."""
    field, threshold = _cloud_field()
    reach = 1.0 / (np.sin(np.maximum(elevation, 0.0)) + CLOUD_BASE)

    def cover(shift: float) -> NDArray[np.float64]:
        r = (reach + shift)[:, None]
        rows = (r * np.sin(azimuth) * 60.0).astype(int) % 512
        columns = (r * np.cos(azimuth) * 60.0).astype(int) % 512
        return np.asarray(np.clip((field[rows, columns] - threshold) / 1.1, 0.0, 1.0))

    thickness = cover(0.0)
    fading = np.clip(np.sin(np.maximum(elevation, 0.0)) / 0.10, 0.0, 1.0)[:, None]
    opacity = (np.sqrt(thickness) * fading * 0.9)[..., None]
    shade = (1.0 - 0.30 * cover(0.25))[..., None]
    sky *= 1.0 - opacity
    sky += opacity * shade * parameters.CLOUD


@cache
def _cloud_field() -> tuple[NDArray[np.float64], float]:
    """Thickness of the clouds on their plane, (512, 512), and that above which they are seen."""
    field = noise((512, 512), 8, 30, octaves=6, fade=0.55)
    return field, float(np.quantile(field, 1.0 - parameters.CLOUD_COVER))


def _add_skyline(sky: NDArray[np.float64], elevation: NDArray[np.float64], daylight: Daylight) -> None:
    """Hills at 6 km and woods at 1.2 km, each behind the haze of its distance."""
    light = daylight.on(np.array([0.0, 0.0, 1.0]))
    for distance, mean, varies, colour, cells, seed in (
        (6000.0, 0.030, 0.009, 0.8 * np.array(parameters.LEAVES) * light, 6, 31),
        (1200.0, 0.006, 0.0028, 0.55 * np.array(parameters.LEAVES) * light, 96, 32),
    ):
        outline = mean + varies * noise((8, COLUMNS), cells, seed, octaves=4, fade=0.6)[0]
        arrives = math.exp(-parameters.HAZE * distance)
        shown = arrives * colour + (1.0 - arrives) * np.array(parameters.HORIZON)
        pixel = (HIGHEST - LOWEST) / ROWS
        share = np.clip((outline[None] - elevation[:, None]) / pixel + 0.5, 0.0, 1.0)[..., None]
        sky += share * (shown - sky)


def sky_dome() -> Any:
    """Panda3D's node of the dome, around the origin."""
    azimuths = np.linspace(0.0, math.tau, 65)
    elevations = np.concatenate((np.linspace(LOWEST, math.radians(40.0), 9), [HIGHEST, math.radians(90.0)]))
    vertices = np.zeros((len(elevations), len(azimuths)), VERTEX)
    radius = 100.0
    flat = radius * np.cos(elevations)[:, None]
    vertices["position"] = np.stack(
        np.broadcast_arrays(flat * np.cos(azimuths), flat * np.sin(azimuths), radius * np.sin(elevations)[:, None]),
        axis=-1,
    )
    vertices["texture"][..., 0] = azimuths / math.tau
    vertices["texture"][..., 1] = ((elevations - LOWEST) / (HIGHEST - LOWEST))[:, None]
    return mesh_node("sky", vertices.reshape(-1), strip_triangles(*vertices.shape))


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

    Returns a texture, 1 in full shadow of what stands beside the road, and in a second channel, if any, in one of
    conditions; x and y of its corner, m, and its scale, 1/m. The solids have no parent afterwards.
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
