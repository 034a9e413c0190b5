# SPDX-License-Identifier: Apache-2.0
"""Where the lines of a road are in the pictures, what conditions make of them, and that pictures are repeatable."""

from __future__ import annotations

import hashlib
import math
import multiprocessing
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from ds_road import Road, generate
from ds_sim.camera.optics import light_of
from ds_sim.conditions.model import DEFAULT, Conditions, NotApplicableError
from ds_sim.registry import make_simulator
from ds_sim.simulator import Command, VehicleState
from ds_sim.testing import STRAIGHT, WINDING, digest, drive, reference_driver
from ds_sim_torcs.host import TorcsHost
from ds_sim_torcs.scene import LOOK, TorcsScene
from ds_sim_torcs.simulator import CAMERA, TorcsSimulator
from ds_sim_torcs.world import road_texture

DOWN = replace(CAMERA, pitch=math.pi / 2, height=5.0, forward=0.0)
"""Looks straight down; a pixel is 3.4 cm of road."""
RNG = np.random.default_rng(0)


def at(x: float, y: float, yaw: float, *, roll: float = 0.0, pitch: float = 0.0) -> VehicleState:
    return VehicleState(x=x, y=y, yaw=yaw, speed=0.0, yaw_rate=0.0, steering_angle=0.0, roll=roll, pitch=pitch)


def left_of_middle(pixels: NDArray[np.uint8], expected: float, *, yellow: bool) -> float:
    """Distance of a line to the left of the picture's middle, m, in a row of a picture that looks down.

    Looked for within a metre, as another stretch of a winding road may be in view.
    """
    metre = DOWN.intrinsics[0, 0] / DOWN.height
    levels, left = pixels.astype(float), (159.5 - np.arange(320)) / metre
    weight = np.maximum(levels[:, 0] - levels[:, 2] - 60.0 if yellow else levels[:, 2] - 125.0, 0.0)
    weight[np.abs(left - expected) > 1.0] = 0.0
    return float((weight * left).sum() / weight.sum())


def test_the_lane_that_is_seen_is_within_5_cm_of_the_roads_own(host: TorcsHost) -> None:
    """On 20 random roads, at every tenth sample, from the yellow line and the white one on the right."""
    scene, errors = TorcsScene(host, DOWN), []
    inset = LOOK.line_width / 2
    for seed in range(20):
        road = generate(np.random.default_rng(seed), max_angle=150 if seed % 2 else 270)
        scene.load(road, RNG)
        lane, ahead = road.right_lane_centre, np.diff(road.points, axis=0)
        for k in range(5, len(ahead) - 5, 10):
            row = scene.still(at(float(lane[k, 0]), float(lane[k, 1]), math.atan2(ahead[k, 1], ahead[k, 0])))[79]
            left, right = left_of_middle(row, 2.0, yellow=True), left_of_middle(row, inset - 2.0, yellow=False)
            errors.append((left + right - inset) / 2)
    assert len(errors) > 200 and max(map(abs, errors)) < 0.05 and abs(np.mean(errors)) < 0.005


@pytest.mark.parametrize(("roll", "pitch"), [(0.0, 0.0), (0.08, 0.0), (-0.06, 0.05), (0.0, -0.04)])
def test_the_camera_follows_the_body(host: TorcsHost, roll: float, pitch: float) -> None:
    """The centre line of a straight road against a projection written here."""
    scene = TorcsScene(host, CAMERA)
    scene.load(STRAIGHT, RNG)
    image = scene.still(at(127.0, 60.0, math.pi / 2, roll=roll, pitch=pitch)).astype(float)
    rotate_x = np.array([[1, 0, 0], [0, math.cos(roll), -math.sin(roll)], [0, math.sin(roll), math.cos(roll)]])
    pitched = np.array([[math.cos(pitch), 0, math.sin(pitch)], [0, 1, 0], [-math.sin(pitch), 0, math.cos(pitch)]])
    tilted = CAMERA.pitch
    for distance in (5.0, 8.0, 14.0):
        # Ahead, left and up of the body's centre, then of the camera.
        point = (pitched @ rotate_x).T @ np.array([distance, 2.0, 0.0]) - [CAMERA.forward, 0.0, CAMERA.height]
        depth = point[0] * math.cos(tilted) - point[2] * math.sin(tilted)
        below = -point[0] * math.sin(tilted) - point[2] * math.cos(tilted)
        focal = CAMERA.intrinsics[0, 0]
        column, row = 159.5 - focal * point[1] / depth, 79.5 + focal * below / depth
        levels = image[round(row)]
        weight = np.maximum(levels[:, 0] - levels[:, 2] - 30.0, 0.0)
        weight[: max(round(column) - 12, 0)] = weight[round(column) + 12 :] = 0.0
        slope = 2.0 * (round(row) - row)  # of the line, columns a row, at most
        assert (weight * np.arange(320)).sum() / weight.sum() == pytest.approx(column, abs=1.0 + abs(slope))


def test_asphalt_and_paint_have_the_colours_and_the_contrast_that_are_claimed(host: TorcsHost) -> None:
    scene, own = TorcsScene(host, DOWN), light_of(LOOK.edge_line) - light_of(LOOK.asphalt)
    state = at(127.0, 80.0, math.pi / 2)
    for contrast in (1.0, 0.5, 0.1, 0.0):
        scene.load(STRAIGHT, RNG, Conditions(line_contrast=contrast))
        row = scene.still(state)[79]
        edge = round(159.5 + 1.925 * DOWN.intrinsics[0, 0] / DOWN.height)
        assert row[160].tolist() == list(LOOK.asphalt)
        assert light_of(tuple(row[edge].tolist())) - light_of(LOOK.asphalt) == pytest.approx(contrast * own, abs=0.02)
    scene.load(STRAIGHT, RNG, Conditions(pavement_reflectance=0.3))
    assert light_of(tuple(scene.still(state)[79, 160].tolist())).mean() == pytest.approx(0.3, rel=0.03)


@pytest.mark.parametrize("lane_width", [1.0, 4.0, 20.0])
def test_a_line_is_as_wide_as_it_is_claimed_on_any_road(lane_width: float) -> None:
    texture = road_texture(lane_width, LOOK, DEFAULT)
    assert texture.shape[0] & (texture.shape[0] - 1) == 0 and texture.shape[1:] == (8, 3)
    light = np.array([light_of(tuple(texel)) for texel in texture[:, 0].tolist()])[:, 2]
    painted = (light - light_of(LOOK.asphalt)[2]) / (light_of(LOOK.edge_line)[2] - light_of(LOOK.asphalt)[2])
    texel = 2.0 * lane_width / len(texture)
    for side in (painted[: len(painted) // 3], painted[-len(painted) // 3 :]):
        assert side.sum() * texel == pytest.approx(LOOK.line_width, rel=0.03)
    assert np.array_equal(painted[: len(painted) // 3], painted[::-1][: len(painted) // 3])


def test_fog_hides_what_is_far_and_not_what_is_near(host: TorcsHost) -> None:
    scene = TorcsScene(host, CAMERA)
    state = at(127.0, 60.0, math.pi / 2)
    scene.load(STRAIGHT, RNG)
    clear = scene.still(state).astype(int)
    scene.load(STRAIGHT, RNG, Conditions(visibility=30.0))
    foggy = scene.still(state).astype(int)
    assert np.abs(foggy[62:64] - LOOK.horizon).max() < 12
    assert np.abs(foggy[150] - clear[150]).mean() < 0.6 * np.abs(foggy[75] - clear[75]).mean()


ALL = Conditions(
    line_contrast=0.5, illuminance=500.0, veiling_luminance=100.0, low_sun=2000.0, sun_azimuth=1.5, sun_elevation=0.2,
    visibility=150.0, pavement_reflectance=0.2, camera_height=1.1, camera_pitch=0.03, camera_yaw=-0.03, lens_dirt=0.1,
    sensor_noise=4.0, exposure=1.2, steering_lag=0.1, command_delay=0.1, friction=0.8, payload=0.2, tyre_pull=0.002,
    speed_limit=7.0,
)  # fmt: skip


def run(simulator: TorcsSimulator, conditions: Conditions, steps: int = 30) -> str:
    pilot = reference_driver(simulator.spec.autopilot)
    frames = [simulator.load(WINDING, seed=5, conditions=conditions)]
    for _ in range(steps):
        frames.append(simulator.step(pilot(frames[-1])))
    return digest(frames)


def run_elsewhere(conditions: Conditions) -> str:
    simulator = TorcsSimulator()
    try:
        return run(simulator, conditions)
    finally:
        simulator.close()


@pytest.mark.usefixtures("host")
@pytest.mark.parametrize("conditions", [DEFAULT, ALL])
def test_a_run_has_the_same_bytes_in_any_process_and_after_any_road(conditions: Conditions) -> None:
    simulator = TorcsSimulator()
    first = run(simulator, conditions)
    drive(simulator, generate(np.random.default_rng(4), max_angle=270), lambda seen: Command(0.3, 1.0), steps=40)
    run(simulator, ALL)
    assert run(simulator, conditions) == first
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.apply(run_elsewhere, (conditions,)) == first
    simulator.close()


def test_rows_that_are_drawn_have_the_same_bits_under_conditions(host: TorcsHost) -> None:
    scene, state = TorcsScene(host, CAMERA), at(127.0, 60.0, math.pi / 2)
    pictures = []
    for rows in ((0, 160), (60, 160)):
        scene.draw_rows(*rows)
        scene.load(STRAIGHT, np.random.default_rng(3), ALL)
        pictures.append(scene.image(state))
    assert np.array_equal(pictures[0][60:], pictures[1][60:]) and not pictures[1][:60].any()


@pytest.mark.usefixtures("host")
def test_what_it_cannot_realise_is_refused_by_name() -> None:
    simulator = make_simulator("torcs")
    with pytest.raises(
        NotApplicableError, match="torcs cannot realise shadow_density, repair_share: it realises line_"
    ):
        simulator.load(STRAIGHT, seed=1, conditions=Conditions(shadow_density=0.2, repair_share=0.1))
    assert set(ALL.changed) == set(simulator.spec.conditions)
    simulator.close()


def test_the_picture_of_a_road_does_not_depend_on_where_it_lies(host: TorcsHost) -> None:
    """A road moved by 3 km looks the same: the world's origin is the road's."""
    scene, pictures = TorcsScene(host, CAMERA), []
    for x, y in ((0.0, 0.0), (2048.0, -3072.0)):
        scene.load(Road([(125.0 + 8.0 * (i % 2) + x, 25.0 * i + y) for i in range(9)]), RNG)
        pictures.append(scene.still(at(127.0 + x, 60.0 + y, 1.5)))
    assert hashlib.sha256(pictures[0].tobytes()).digest() == hashlib.sha256(pictures[1].tobytes()).digest()
