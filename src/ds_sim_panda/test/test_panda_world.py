# SPDX-License-Identifier: Apache-2.0
"""Checks what stands in the world: clear of the road, shadows away from the sun, haze by Koschmieder's law."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray
from panda_views import CAMERA, STRAIGHT, pose, project
from scipy.spatial import cKDTree

from ds_road import generate
from ds_sim_panda.scene import textures, world
from ds_sim_panda.scene.meshes import course_of
from ds_sim_panda.scene.panda_scene import PandaScene
from ds_sim_panda.scene.parameters import HORIZON, VISIBILITY
from ds_sim_panda.scene.scenery import Things, place_scenery
from ds_sim_panda.scene.setting import own_daylight

RNG = np.random.default_rng(0)
ORIGIN = course_of(STRAIGHT).origin
TEXTURES = ("grass", "gravel", "asphalt", "patches", "materials")


def things(position: tuple[float, float], size: tuple[float, float, float]) -> Things:
    return Things(np.array([position]), np.array([size]), np.zeros(1), np.ones(1))


def only(monkeypatch: pytest.MonkeyPatch, **scenery: Things) -> None:
    """Worlds with these things alone, whose textures have one colour."""
    monkeypatch.setattr(world, "place_scenery", lambda course, seed: scenery)
    for name in TEXTURES:
        getattr(textures, name).cache_clear()
    monkeypatch.setattr(textures, "noise", lambda size, *args, **kwargs: np.zeros(size))


@pytest.fixture(autouse=True)
def real_textures_afterwards() -> Iterator[None]:
    yield
    for name in TEXTURES:
        getattr(textures, name).cache_clear()


VEHICLE = pose(127.0, 60.0, math.pi / 2)


def linear_image() -> NDArray[np.float64]:
    """The straight road from `VEHICLE`, in shares of daylight."""
    scene = PandaScene(CAMERA)
    scene.load(STRAIGHT, RNG)
    return np.square(scene.image(VEHICLE) / 255.0)


def seen_at(image: NDArray[np.float64], x: float, y: float, z: float = 0.0) -> NDArray[np.float64]:
    """Colour of the pixel that shows a point."""
    column, row = project(CAMERA, VEHICLE, np.array([[x, y, z]]))[0, :2].round().astype(int)
    assert 0 <= column < 320 and 0 <= row < 160
    return np.asarray(image[row, column])


@pytest.mark.parametrize("seed", range(12))
def test_nothing_stands_on_the_road_or_its_verge(seed: int) -> None:
    """Measured with points every few centimetres of road instead of the distance to a line."""
    road = generate(np.random.default_rng(seed), max_angle=270)
    course = course_of(road)
    steps = np.linspace(0.0, 1.0, 40)[:, None, None]
    dense = (course.points[None, :-1] * (1 - steps) + course.points[None, 1:] * steps).reshape(-1, 2)
    nearest = cKDTree(dense)
    scenery = place_scenery(course, int(road.road_id, 16))
    assert len(scenery["post"].position) > 6 and sum(len(t.position) for t in scenery.values()) > 60
    for kind, of_kind in scenery.items():
        distance, _ = nearest.query(of_kind.position)
        assert (distance - of_kind.reach > 4.0 + 1.0).all(), kind
    again = place_scenery(course, int(road.road_id, 16))
    assert all(np.array_equal(again[kind].position, scenery[kind].position) for kind in scenery)


def test_the_sun_stands_where_the_almanac_says() -> None:
    """Lugano, 1 June, half past eight in solar time: an altitude of 41 degrees, 11 degrees south of east."""
    x, y, z = own_daylight().towards_sun
    assert math.degrees(math.asin(z)) == pytest.approx(41.4, abs=0.3)
    assert math.degrees(math.atan2(-y, x)) == pytest.approx(11.0, abs=0.5)
    light = own_daylight().sun_on_ground + own_daylight().sky
    assert light @ [0.2126, 0.7152, 0.0722] == pytest.approx(1.0, abs=0.02)


def test_a_shadow_falls_away_from_the_sun_and_is_lit_by_the_sky(monkeypatch: pytest.MonkeyPatch) -> None:
    """The shadow of a post of 8 m lies across the road, where the sun's direction puts it."""
    daylight = own_daylight()
    sun = np.array(daylight.towards_sun)
    foot = np.array([133.0, 66.0])
    tip = foot - 8.0 / sun[2] * sun[:2]
    only(monkeypatch, post=things((133.0 - ORIGIN[0], 66.0 - ORIGIN[1]), (0.5, 0.5, 8.0)))
    shaded = linear_image()
    only(monkeypatch)
    lit = linear_image()
    expected = daylight.sky / (daylight.sky + daylight.sun_on_ground)
    for share, ratio in ((0.55, expected), (0.8, expected), (1.15, 1.0)):
        place = foot + share * (tip - foot)
        # The haze adds a little light to what is dark.
        assert seen_at(shaded, *place) / seen_at(lit, *place) == pytest.approx(ratio, abs=0.02), share
    for x, y in ((133.5, 70.0), (131.0, 70.0), (129.0, 63.5)):
        assert seen_at(shaded, x, y) == pytest.approx(seen_at(lit, x, y))


def test_contrast_fades_with_distance_by_koschmieders_law(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the difference to the horizon's colour, 2% are left at the visibility."""
    contrast = {}
    for distance in (40.0, 1500.0, 4000.0):
        scale = distance / 40.0  # so that each appears alike: a white block, seen from the front
        y = 60.3 + distance
        block = things((133.0 - ORIGIN[0], y + 3.0 * scale - ORIGIN[1]), (3.0 * scale,) * 3)
        only(monkeypatch, post=block)
        contrast[distance] = seen_at(linear_image(), 133.0, y, scale) - HORIZON
    for distance in (1500.0, 4000.0):
        share = 0.02 ** ((distance - 40.0) / VISIBILITY)
        assert contrast[distance] == pytest.approx(share * contrast[40.0], abs=0.008)


@pytest.mark.parametrize("variable", ["LIBGL_DRIVERS_PATH", "__EGL_VENDOR_LIBRARY_FILENAMES"])
def test_missing_libraries_are_named_in_one_line(variable: str) -> None:
    code = (
        "from ds_sim_panda.scene.graphics import renderer_name\n"
        "try: renderer_name()\n"
        "except Exception as error: print(type(error).__name__, error)\n"
    )
    environment = {**os.environ, variable: "/nonexistent"}
    ran = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=60)
    assert ran.stderr == "" and ran.stdout.count("\n") == 1
    assert ran.stdout.startswith(
        "SimulatorError the panda simulator cannot draw: OpenGL does not start: install libegl1"
    )
