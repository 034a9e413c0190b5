# SPDX-License-Identifier: Apache-2.0
"""Files that TORCS's renderer reads for a road: a mesh of road, grass and sky, and its textures."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_base.folder_files import write_whole
from ds_road import Road
from ds_road.geometry import arc_lengths
from ds_sim.camera.optics import encode, light_of
from ds_sim.camera.spec import Look
from ds_sim.conditions.model import Conditions
from ds_sim_torcs.host import DATA

WORLD_CONDITIONS = frozenset({"line_contrast", "pavement_reflectance"})
"""Conditions that change the world's textures."""
NAME = "world"
"""Name of the track whose mesh is the world."""
BACKGROUND = DATA / "tracks/road/alpine-1/background.png"
"""Panorama of TORCS: sky, hills, a row of trees."""
TREES_END = 381
"""Row of the panorama at which the trees stand on the ground; read off the picture."""
SKY_HEIGHT = math.tan(math.radians(28.0))
"""Height of the panorama over its distance; chosen: the hills reach 8 degrees above the horizon."""
RADIUS = 1500.0
"""Distance of the panorama, m; chosen: a car on a road sees it turn by less than a tenth of its own turns."""
SECTORS = 72
"""Sides of the panorama; chosen: 5 degrees each, which bend no horizon."""
SKY_TEXELS = (256, 4096)
"""Rows and columns of the panorama; chosen: two columns a pixel."""
GRASS = "tr-grass.rgb"
"""TORCS's texture of grass."""
GRASS_TILE = 20.0
"""Side of the grass that a texture covers, m; TORCS's tracks have 10 to 50."""
GRASS_BELOW = 0.05
"""Depth of the grass below the road, m; chosen: the depth buffer tells them apart to 300 m."""
LEAD_IN, LEAD_OUT = 30.0, 60.0
"""Straight road before the first and after the last point, m; chosen: a car at the end still sees road."""
TEXEL = 0.032
"""Largest width of a texel across the road, m; chosen: a line is five texels wide."""
TEXTURE_LENGTH = 1000.0
"""Length of road that a texture covers, m; chosen: as it does not change along the road, mipmaps follow its width."""
_COLUMNS = 8


@dataclass(frozen=True)
class _Strip:
    """Triangle strip with one texture: vertices (n, 3), m, and texture coordinates (n, 2)."""

    texture: str
    vertices: NDArray[np.float64]
    places: NDArray[np.float64]

    def ac3d(self) -> str:
        """Object of an AC3D file, whose y axis points up."""
        vertices = "\n".join(f"{x:.6f} {z:.6f} {-y:.6f}" for x, y, z in self.vertices.tolist())
        refs = "\n".join(f"{index} {u:.7f} {v:.7f}" for index, (u, v) in enumerate(self.places.tolist()))
        return (
            f'OBJECT poly\nname "{self.texture}"\ntexture "{self.texture}"\nnumvert {len(self.vertices)}\n{vertices}\n'
            f"numsurf 1\nSURF 0x34\nmat 0\nrefs {len(self.vertices)}\n{refs}\nkids 0\n"
        )


def write_world(folder: Path, road: Road, look: Look, conditions: Conditions) -> tuple[float, float]:
    """Write the world of a road in place of the last one.

    Args:
        folder: working directory of the host.
        road: the road.
        look: colours of the road and its lines, and the width of these.
        conditions: of the run.

    Returns:
        Place of the world's origin in the road frame, m: the start of the driven lane, near which single precision is
        finest.
    """
    track = folder / "tracks/road" / NAME
    origin = road.lane_centre[0]
    strips = [_road_strip(road, origin), *_grass_strips(), _sky_strip()]
    mesh = f"AC3Db\n{_MATERIAL}OBJECT world\nkids {len(strips)}\n" + "".join(strip.ac3d() for strip in strips)
    write_whole(track / f"{NAME}.ac", mesh)
    write_whole(track / f"{NAME}.xml", _TRACK)
    write_rgb(track / "road.rgb", road_texture(road.half_width, look, conditions, two_lanes=road.has_centre_line))
    sky = track / "sky.rgb"
    if not sky.is_file():
        write_rgb(sky, _panorama())
    return float(origin[0]), float(origin[1])


def road_texture(half_width: float, look: Look, conditions: Conditions, *, two_lanes: bool = True) -> NDArray[np.uint8]:
    """Texture across the road, (texels, 8, 3) RGB, first row at its left border; the same in all columns.

    A line's border covers part of a texel, by which the texel's light is mixed.
    """
    texels = 2 ** math.ceil(math.log2(2.0 * half_width / TEXEL))
    edges = np.linspace(-half_width, half_width, texels + 1)
    asphalt = light_of(look.asphalt)
    if conditions.pavement_reflectance is not None:
        asphalt = asphalt * np.float32(conditions.pavement_reflectance / asphalt.mean())
    light = np.tile(asphalt, (texels, 1))
    inset, half = half_width - look.line_width / 2.0, look.line_width / 2.0
    lines = ((-inset, look.edge_line), (0.0, look.centre_line), (inset, look.edge_line))
    for middle, colour in lines if two_lanes else lines[::2]:
        covered = np.diff(np.clip(edges, middle - half, middle + half)) / np.diff(edges)
        share = (conditions.line_contrast * covered).astype(np.float32)[:, None]
        light += share * (light_of(colour) - light)
    return np.repeat(encode(light)[:, None], _COLUMNS, axis=1)


def write_rgb(path: Path, image: NDArray[np.uint8]) -> None:
    """Write an uncompressed SGI image, which TORCS reads byte by byte.

    Args:
        path: of the file.
        image: (rows, columns, 3) RGB, bottom row first, both sides powers of two.
    """
    rows, columns, colours = image.shape
    head = b"".join(
        value.to_bytes(size, "big")
        for value, size in ((474, 2), (0, 1), (1, 1), (3, 2), (columns, 2), (rows, 2), (colours, 2), (0, 4), (255, 4))
    )
    write_whole(path, head.ljust(512, b"\0") + np.ascontiguousarray(image.transpose(2, 0, 1)).tobytes())


def _road_strip(road: Road, origin: NDArray[np.float64]) -> _Strip:
    """The road between its borders, with a straight lead at either end; its own samples are kept."""
    borders = np.stack((road.left_edge, road.right_edge), axis=1) - origin
    across = (borders[:, 1] - borders[:, 0]) / (2.0 * road.half_width)
    ahead = np.stack((-across[:, 1], across[:, 0]), axis=1)
    borders = np.concatenate((borders[:1] - LEAD_IN * ahead[0], borders, borders[-1:] + LEAD_OUT * ahead[-1]), axis=0)
    along = arc_lengths(borders.mean(axis=1)) / TEXTURE_LENGTH
    vertices = np.zeros((len(borders), 2, 3))
    vertices[:, :, :2] = borders
    places = np.stack((np.stack((along, along), axis=1), np.broadcast_to([0.0, 1.0], (len(along), 2))), axis=2)
    return _Strip("road.rgb", vertices.reshape(-1, 3), places.reshape(-1, 2))


@cache
def _grass_strips() -> tuple[_Strip, ...]:
    """The plane around the origin as square tiles, the same around every road."""
    steps = np.linspace(-RADIUS, RADIUS, 31)
    strips = []
    for near, far in zip(steps[:-1], steps[1:], strict=True):
        x, y = np.repeat(steps, 2), np.tile([near, far], len(steps))
        vertices = np.column_stack((x, y, np.full(len(x), -GRASS_BELOW)))
        strips.append(_Strip(GRASS, vertices, vertices[:, :2] / GRASS_TILE))
    return tuple(strips)


@cache
def _sky_strip() -> _Strip:
    """The panorama around the origin."""
    turns = np.repeat(np.linspace(0.0, 1.0, SECTORS + 1), 2)
    high = np.tile([0.0, 1.0], SECTORS + 1)
    x, y = RADIUS * np.cos(math.tau * turns), RADIUS * np.sin(math.tau * turns)
    return _Strip("sky.rgb", np.column_stack((x, y, high * RADIUS * SKY_HEIGHT)), np.column_stack((1.0 - turns, high)))


@cache
def _panorama() -> NDArray[np.uint8]:
    """TORCS's panorama above the ground, bottom row first, RGB."""
    image = cv2.imread(str(BACKGROUND), cv2.IMREAD_COLOR)
    rows, columns = SKY_TEXELS
    above = cv2.resize(np.asarray(image)[:TREES_END], (columns, rows), interpolation=cv2.INTER_LINEAR)
    return np.asarray(cv2.cvtColor(above[::-1], cv2.COLOR_BGR2RGB), np.uint8)


_MATERIAL = 'MATERIAL "m" rgb 1 1 1 amb 1 1 1 emis 0 0 0 spec 0 0 0 shi 0 trans 0\n'
_LIGHT = "".join(
    f'  <attnum name="{kind} color {colour}" val="{value}"/>\n'
    for kind, value in (("ambient", 1), ("diffuse", 0), ("specular", 0))
    for colour in "RGB"
)
_TRACK = f"""<?xml version="1.0" encoding="UTF-8"?>
<!DOCTYPE params SYSTEM "params.dtd">
<params name="{NAME}" type="param" mode="mw">
<section name="Graphic">
  <attstr name="3d description" val="{NAME}.ac"/>
{_LIGHT}</section>
</params>
"""
"""What the renderer reads of a track: light from everywhere, under which textures show their own colours."""
