# SPDX-License-Identifier: Apache-2.0
"""Pictures by an independent projection, what stands beside the road, and the car by its publishers' package."""

from __future__ import annotations

import hashlib
import math
import multiprocessing
import os
import subprocess
import sys
import threading
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from panda_views import CAMERA, STRAIGHT, lane_pose, pose, project
from scipy.spatial import cKDTree
from tests.observations import drive
from vehiclemodels.vehicle_dynamics_mb import vehicle_dynamics_mb

from ds_road import Road, generate
from ds_sim.simulator import FRAME_TIME, SimulatorError, VehicleState
from ds_sim_panda.scene import world
from ds_sim_panda.scene.meshes import course_of
from ds_sim_panda.scene.scenery import place_scenery
from ds_sim_panda.scene.setting import own_daylight
from ds_sim_panda.simulator import MultiBodyVehicle, PandaScene
from ds_sim_panda.vehicle import parameters as published
from ds_sim_panda.vehicle.integration import derivative
from ds_sim_panda.vehicle.parameters import MultiBodyParameters

WINDING = generate(np.random.default_rng(11), max_angle=150)
RNG = np.random.default_rng(0)


def loaded(road: Road) -> PandaScene:
    scene = PandaScene(CAMERA)
    scene.load(road, RNG)
    return scene


def line_centre(pixels: NDArray[np.uint8], expected: float, *, yellow: bool) -> float:
    """Position of a line in a row or column of pixels near an expected one: centre of mass of what is coloured so."""
    start = max(round(expected) - 9, 0)
    part = pixels[start : round(expected) + 10].astype(float)
    weight = part[:, 0] - part[:, 2] if yellow else part.min(axis=1)
    weight = np.maximum(weight - 0.5 * (weight.max() + np.median(weight)), 0.0)
    return float(start + (weight * np.arange(len(weight))).sum() / weight.sum())


@pytest.mark.parametrize(
    ("yaw", "roll", "pitch", "heave"),
    [(0.0, 0.0, 0.0, 0.0), (0.15, 0.0, 0.05, 0.0), (-0.1, 0.08, 0.0, 0.1), (0.05, -0.1, -0.04, -0.05)],
)
def test_lines_are_where_an_independent_projection_puts_them(
    monkeypatch: pytest.MonkeyPatch, yaw: float, roll: float, pitch: float, heave: float
) -> None:
    monkeypatch.setattr(world, "place_scenery", lambda course, seed: {})  # no shadows on the lines
    scene = loaded(STRAIGHT)
    at = lane_pose(STRAIGHT, 30)
    vehicle = pose(at.x, at.y, at.yaw + yaw, roll, pitch, heave)
    image = scene.image(vehicle)
    inset = 0.075 / STRAIGHT.lane_width  # a border line lies inside the border
    right = STRAIGHT.right_edge + inset * (STRAIGHT.points - STRAIGHT.right_edge)
    for line, yellow in ((STRAIGHT.points, True), (right, False)):
        ahead = np.linspace(line[0], line[-1], 4000)
        seen = project(CAMERA, vehicle, np.column_stack((ahead, np.zeros(len(ahead)))))
        seen = seen[(seen[:, 2] > 2.0) & (seen[:, 2] < 12.0) & (np.abs(seen[:, 0] - 159.5) < 150)]
        # Across the line as the picture shows it: along rows, or along columns where the line is flat.
        steep = np.ptp(seen[:, 1]) > np.ptp(seen[:, 0])
        along, across = (1, 0) if steep else (0, 1)
        order = seen[:, along].argsort()
        places = range(int(seen[:, along].min()) + 1, min(int(seen[:, along].max()), (160 if steep else 320) - 1), 4)
        assert len(places) >= 6
        for place in places:
            expected = float(np.interp(place, seen[order, along], seen[order, across]))
            if 10 < expected < (310 if steep else 150):
                found = line_centre(image[place] if steep else image[:, place], expected, yellow=yellow)
                assert found == pytest.approx(expected, abs=0.7)


def digest(scene: PandaScene, states: list[VehicleState]) -> str:
    return hashlib.sha256(b"".join(scene.image(state).tobytes() for state in states)).hexdigest()


STATES = [lane_pose(WINDING, index) for index in (0, 20, 40)]


def digest_elsewhere() -> str:
    return digest(loaded(WINDING), STATES)


def test_the_bits_depend_on_the_road_alone() -> None:
    scene, other = loaded(WINDING), loaded(STRAIGHT)
    first = digest(scene, STATES)
    scene.load(STRAIGHT, RNG)
    assert digest(scene, STATES) != first
    other.load(WINDING, np.random.default_rng(5))
    assert digest(other, STATES) == first
    other.close()
    scene.load(WINDING, RNG)
    assert digest(scene, STATES) == first

    found = []
    for draw in (lambda: digest(scene, STATES), digest_elsewhere):
        thread = threading.Thread(target=lambda draw=draw: found.append(draw()))  # type: ignore[misc]
        thread.start()
        thread.join(60.0)
    assert [*found, digest(scene, STATES)] == [first] * 3
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.apply_async(digest_elsewhere).get(60.0) == first


def test_rows_that_are_drawn_keep_their_bits() -> None:
    scene = loaded(WINDING)
    whole = scene.image(STATES[1])
    assert not whole.flags.writeable
    for top, bottom in ((54, 160), (61, 62), (0, 80)):
        scene.draw_rows(top, bottom)
        scene.load(WINDING, RNG)
        part = scene.image(STATES[1])
        assert np.array_equal(part[top:bottom], whole[top:bottom])
        assert not part[:top].any() and not part[bottom:].any()
    with pytest.raises(ValueError, match="expected 0 <= top < bottom <= 160"):
        scene.draw_rows(10, 161)


def test_a_scene_without_a_road_and_other_cameras_are_refused() -> None:
    scene = PandaScene(CAMERA)
    with pytest.raises(SimulatorError, match="load one first"):
        scene.image(STATES[0])
    with pytest.raises(ValueError, match=r"camera\.lens is equidistant, expected pinhole"):
        PandaScene(replace(CAMERA, lens="equidistant"))


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


P = MultiBodyParameters()


@pytest.fixture
def car() -> MultiBodyVehicle:
    vehicle = MultiBodyVehicle()
    vehicle.reset(0.0, 0.0, 0.0, RNG)
    return vehicle


@pytest.mark.parametrize("number", [1, 2, 3])
def test_the_right_hand_side_is_that_of_the_package_at_random_states(number: int) -> None:
    rng = np.random.default_rng(number)
    reference = published.parameter_set(number)
    compiled = published.record(reference)
    rest = published.rest_state(number)
    spread = np.full(published.STATES, 0.05)
    spread[[published.X, published.Y, published.YAW]] = 100.0
    spread[[published.STEERING, published.YAW_RATE]] = 0.8
    spread[published.WHEEL_SPEEDS : published.WHEEL_SPEEDS + 4] = 10.0
    spread[[published.LATERAL_SPEED, published.FRONT_LATERAL_SPEED, published.REAR_LATERAL_SPEED]] = 1.0
    kinematic = 0
    for _ in range(1000):
        state = rest + spread * rng.standard_normal(published.STATES)
        state[published.SPEED] = rng.choice([rng.uniform(0.1, 15.0), rng.uniform(0.0, 0.12), rng.uniform(-1.0, 1.0)])
        kinematic += abs(state[published.SPEED]) < 0.1
        inputs = rng.uniform(-1.0, 1.0, 2) * (1.0, 15.0)
        found = np.empty(published.STATES)
        derivative(state.copy(), inputs, compiled, found)
        try:
            expected = vehicle_dynamics_mb(state.tolist(), inputs.tolist(), reference)
        except ZeroDivisionError:  # a wheel that stands while the car moves
            assert not np.isfinite(found).all()
            continue
        assert found == pytest.approx(expected, rel=1e-12, abs=1e-12)
    assert 100 < kinematic < 900


def test_a_start_does_not_spin_the_wheels_and_a_stop_is_final(car: MultiBodyVehicle) -> None:
    starting = drive(car, 40, 0.0, 1.0)
    assert all(b.speed > a.speed for a, b in zip(starting[:-1], starting[1:], strict=True))
    assert starting[-1].speed == pytest.approx(P.drive_acceleration * 2.0, rel=0.05)
    stopping = drive(car, 200, 0.0, 0.0)
    assert all(b.speed <= a.speed for a, b in zip(stopping[:-1], stopping[1:], strict=True))
    assert 0.0 <= stopping[-1].speed < 1e-2
    p = P.published
    rotating = 4 * p.I_y_w / p.R_w**2
    slowing = (stopping[5].speed - stopping[15].speed) / (10 * FRAME_TIME)
    assert slowing == pytest.approx(P.regenerative_deceleration * p.m / (p.m + rotating), rel=0.01)


def test_the_steering_has_the_published_rate(car: MultiBodyVehicle) -> None:
    angles = [0.0, *(s.steering_angle for s in drive(car, 60, 1.0, 0.0))]
    assert np.abs(np.diff(angles)).max() == pytest.approx(0.4 * FRAME_TIME)
    assert angles[-1] == pytest.approx(-0.91)


def test_another_version_of_the_model_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(published, "VERSION", "1.0")
    with pytest.raises(ImportError, match=r"^commonroad-vehicle-models is 3.0.2, expected 1.0: pip install \S+==1.0$"):
        MultiBodyVehicle()
