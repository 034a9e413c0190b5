# SPDX-License-Identifier: Apache-2.0
"""Checks what stands in the world: clear of the road, shadows away from the sun, haze by Koschmieder's law."""

from __future__ import annotations

import math
import os
import subprocess
import sys

import numpy as np
import pytest
from scipy.spatial import cKDTree

from ds_road import generate
from ds_sim_panda.scene.meshes import course_of
from ds_sim_panda.scene.scenery import place_scenery
from ds_sim_panda.scene.setting import own_daylight


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


@pytest.mark.parametrize("variable", ["LIBGL_DRIVERS_PATH", "__EGL_VENDOR_LIBRARY_FILENAMES"])
def test_missing_libraries_are_named_in_one_line(variable: str) -> None:
    code = (
        "from ds_sim_panda.scene.graphics import graphics\n"
        "try: graphics()\n"
        "except Exception as error: print(type(error).__name__, error)\n"
    )
    environment = {**os.environ, variable: "/nonexistent"}
    ran = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=60)
    assert ran.stderr == "" and ran.stdout.count("\n") == 1
    assert ran.stdout.startswith(
        "SimulatorError the panda simulator cannot draw: OpenGL does not start: install libegl1"
    )
