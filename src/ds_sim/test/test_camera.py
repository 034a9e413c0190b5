# SPDX-License-Identifier: Apache-2.0
"""The simulators' cameras: projection, sensor, distant lines, flicker, horizon, motion blur; and a drive as a video."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest
from camera_reference import below_horizon, brute_force, directions, ground_of, psnr, seen_from

from ds_base.palette import PASS, SERIES, rgb
from ds_road import generate
from ds_sim.camera.atlas import Ground
from ds_sim.camera.ground import paint_ground
from ds_sim.camera.rendered_scene import Sensor
from ds_sim.camera.renderer import Camera
from ds_sim.camera.spec import CameraSpec, Look
from ds_sim.registry import DONKEY, make_simulator
from ds_sim.scenario import Scenario
from ds_sim.session import RunRecord, Session, resimulate
from ds_sim.simulator import Command, VehicleState
from ds_sim.testing import STRAIGHT
from ds_sim.video import VideoError, check_path, write_video

Lens = Literal["pinhole", "equidistant"]
LOOK = Look(asphalt=(90, 90, 95), grass=(90, 140, 70), hills=5.0)
CAMERAS = {
    # Those of the three simulators, copied so that the tests of this package need no other.
    "bullet": CameraSpec(horizontal_fov=math.radians(100), height=1.35, forward=0.4, pitch=math.radians(10)),
    "softbody": CameraSpec(horizontal_fov=math.radians(120), height=1.0, forward=1.7, pitch=math.radians(3)),
    "donkey": CameraSpec(
        horizontal_fov=math.radians(120), height=1.92, forward=0.64, pitch=math.radians(12), lens="equidistant"
    ),
}


def pose(x: float, y: float, yaw: float, **more: float) -> VehicleState:
    return VehicleState(**({"x": x, "y": y, "yaw": yaw, "speed": 0.0, "yaw_rate": 0.0, "steering_angle": 0.0} | more))


def project(spec: CameraSpec, vehicle: VehicleState, point: tuple[float, float]) -> tuple[float, float]:
    """Image position of a point on the ground, by SciPy's rotations and the textbook formula of the lens."""
    ((forward, left, up),) = seen_from(spec, vehicle, np.array([[*point, 0.0]]))
    k = spec.intrinsics
    if spec.lens == "equidistant":
        angle = math.atan2(math.hypot(left, up), forward)
        radius = angle / math.hypot(left, up)
        return k[0, 2] - k[0, 0] * radius * left, k[1, 2] - k[1, 1] * radius * up
    return k[0, 2] - k[0, 0] * left / forward, k[1, 2] - k[1, 1] * up / forward


def spotted_ground(point: tuple[float, float]) -> Ground:
    """Grey plane with one white square of 0.4 m around a point."""
    size, resolution = 1200, 0.05
    raster = np.full((size, size, 3), 60, np.uint8)
    column, row = round(point[0] / resolution), round(point[1] / resolution)
    raster[row - 4 : row + 4, column - 4 : column + 4] = 255
    levels = [raster]
    for _ in range(5):
        levels.append(cv2.resize(levels[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
    return ground_of(levels, (60, 60, 60))


def horizon_row(spec: CameraSpec) -> int:
    k = spec.intrinsics
    return int(k[1, 2] - k[1, 1] * (math.tan(spec.pitch) if spec.lens == "pinhole" else spec.pitch))


@pytest.fixture(scope="module")
def straight() -> Ground:
    return paint_ground(STRAIGHT, LOOK)


@pytest.mark.parametrize("lens", ["pinhole", "equidistant"])
@pytest.mark.parametrize(
    ("yaw", "roll", "pitch", "heave"),
    [(0.0, 0.0, 0.0, 0.0), (0.5, 0.0, 0.05, 0.0), (1.2, 0.08, 0.0, 0.1), (-0.7, -0.1, -0.04, -0.05)],
)
@pytest.mark.parametrize("ahead", [(6.0, 0.6), (9.0, -2.0), (14.0, 3.0)])
def test_a_spot_on_the_ground_is_projected_correctly(
    lens: Lens, yaw: float, roll: float, pitch: float, heave: float, ahead: tuple[float, float]
) -> None:
    spec = CameraSpec(horizontal_fov=math.radians(100), height=1.4, forward=0.6, pitch=0.06, lens=lens)
    vehicle = pose(20.0, 30.0, yaw, roll=roll, pitch=pitch, heave=heave)
    rotation = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
    x, y = np.round((rotation @ ahead + (20.0, 30.0)) / 0.05) * 0.05
    frame = Camera(spec, replace(LOOK, hills=0.0)).render(spotted_ground((x, y)), vehicle)[..., 1].astype(float)
    u, v = project(spec, vehicle, (x, y))
    near = frame[max(round(v) - 8, 0) : round(v) + 9, max(round(u) - 14, 0) : round(u) + 15] - 60.0
    near[near < 15.0] = 0.0
    rows, columns = np.indices(near.shape)
    found_u = (near * columns).sum() / near.sum() + max(round(u) - 14, 0)
    found_v = (near * rows).sum() / near.sum() + max(round(v) - 8, 0)
    assert found_u == pytest.approx(u, abs=0.5) and found_v == pytest.approx(v, abs=0.5)


def test_sensor_images_are_seeded_delayed_and_read_only() -> None:
    spec = CameraSpec(horizontal_fov=1.5, height=1.4, noise=4.0, latency=2)
    scenes = [np.full((160, 320, 3), value, np.uint8) for value in (50, 100, 150, 200)]

    def images(seed: int) -> list[np.ndarray]:
        sensor = Sensor(spec, np.random.default_rng(seed))
        return [sensor.deliver(scene) for scene in scenes]

    first, again, other = images(1), images(1), images(2)
    assert [round(float(i.mean()) / 50) * 50 for i in first] == [50, 50, 50, 100]
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not np.array_equal(first[0], other[0])
    assert first[3].std() == pytest.approx(4.0, rel=0.1)
    assert not first[0].flags.writeable


@pytest.mark.parametrize(("name", "roll"), [("bullet", 0.0), ("softbody", 0.0), ("donkey", 0.0), ("bullet", 0.05)])
def test_far_lines_match_sixteen_by_sixteen_rays_per_pixel(name: str, roll: float) -> None:
    """27 rows below the horizon; measured 42 to 46 dB, bilinear sampling has 27 dB."""
    spec = CAMERAS[name]
    road = generate(np.random.default_rng(4), max_angle=60)
    lane = road.right_lane_centre
    ground = paint_ground(road, LOOK)
    vehicle = pose(lane[1, 0], lane[1, 1], math.atan2(*(lane[2] - lane[1])[::-1]), roll=roll)
    first = horizon_row(spec) + 3
    band = range(first, first + 27)
    mask = below_horizon(spec, vehicle, band)
    frame = Camera(spec, LOOK).render(ground, vehicle)[first : first + 27]
    assert psnr(frame[mask], brute_force(spec, ground, vehicle, band)[mask]) > 40.0


@pytest.mark.parametrize("name", CAMERAS)
def test_far_lines_do_not_flicker(name: str) -> None:
    """Driving straight at constant speed changes the far rows much less than nearest-neighbour sampling would."""
    spec = CAMERAS[name]
    look = replace(LOOK, asphalt_grain=0.0, grass_grain=0.0)
    plain = paint_ground(STRAIGHT, look)
    camera = Camera(spec, look)
    first = horizon_row(spec) + 4
    rows = slice(first, first + 14)
    drawn, nearest = [], []
    columns, lines = (a.ravel() for a in np.meshgrid(np.arange(320.0), np.arange(first, first + 14.0)))
    for step in range(24):
        # 0.137 m is not a multiple of the raster pixel: every phase occurs.
        vehicle = pose(127.0, 30.0 + 0.137 * step, math.pi / 2)
        drawn.append(camera.render(plain, vehicle)[rows].astype(float))
        rays, centre = directions(spec, vehicle, columns, lines)
        points = centre[:2] - centre[2] / np.minimum(rays[:, 2:], -1e-6) * rays[:, :2]
        column, row = np.floor((points - plain.origin) / plain.resolution).astype(int).T
        level = plain.levels[0]
        inside = (row >= 0) & (row < level.shape[0]) & (column >= 0) & (column < level.shape[1])
        picked = np.where(inside[:, None], level[row * inside, column * inside, :3], plain.outside)
        nearest.append(picked.reshape(14, 320, 3).astype(float))
    middle = slice(110, 210)
    ours, theirs = (np.std(frames, axis=0)[:, middle].max(axis=1).mean() for frames in (drawn, nearest))
    assert ours < FLICKER and theirs > 3 * ours


FLICKER = 1.0
"""Standard deviation over time of the least steady pixel of each far row, mean over rows, grey levels; measured: 0.6
(bullet), 0.7 (softbody), 0.4 (donkey), with nearest neighbours 2.6, 2.7, 1.5."""


@pytest.mark.parametrize("name", CAMERAS)
def test_the_horizon_moves_smoothly_with_roll_and_pitch(name: str) -> None:
    """The horizon is a straight line over columns without steps, and pitch moves it by fractions of a pixel."""
    spec = replace(CAMERAS[name], lens="pinhole")
    # Sky and ground have one colour each: the sum over a column counts its sky pixels, including fractions.
    look = Look(asphalt=(0, 0, 0), grass=(0, 0, 0), horizon=(200,) * 3, sky_top=(200,) * 3, grass_grain=0.0)
    black = np.zeros((64, 64, 3), np.uint8)
    ground = ground_of((black, black[::2, ::2]), (0, 0, 0))
    camera = Camera(spec, look)
    for roll, pitch in ((0.0, 0.0), (0.003, 0.001), (0.08, 0.002), (-0.05, -0.0035)):
        tilted = pose(1.0, 1.0, 0.3, roll=roll, pitch=pitch)
        sky = camera.render(ground, tilted)[..., 0].sum(axis=0) / 200.0
        rays, _ = directions(spec, tilted, *np.array([[0.0, 319.0], [0.0, 0.0]]))
        below, _ = directions(spec, tilted, *np.array([[0.0, 319.0], [1.0, 1.0]]))
        ends = rays[:, 2] / (rays[:, 2] - below[:, 2])
        expected = np.interp(np.arange(320), (0, 319), ends) + 0.5
        assert np.abs(sky - expected).max() < 0.15


@pytest.mark.parametrize(
    ("columns", "rows", "bent"), [(slice(160, 320), (65, 160), 1.0), (slice(4, 160), (74, 99), 0.7)]
)
def test_undistortion_with_the_specified_coefficients_makes_the_edges_straight(
    straight: Ground, columns: slice, rows: tuple[int, int], bent: float
) -> None:
    """cv2.undistort with K and D of the twin straightens both edge lines to less than half a pixel."""
    spec = CAMERAS["donkey"]
    assert len(spec.distortion) == 8
    frame = Camera(spec, LOOK).render(straight, pose(127.0, 40.0, math.pi / 2))
    flat = cv2.undistort(frame, spec.intrinsics, np.array(spec.distortion))

    def bend(image: np.ndarray) -> float:
        """Largest deviation of the centre of the white line from a straight line, px."""
        white = np.clip(image[slice(*rows), columns].min(axis=2).astype(float) - 130.0, 0.0, None)
        middle = (white * np.arange(white.shape[1])).sum(axis=1) / white.sum(axis=1)
        number = np.arange(len(middle))
        return float(np.abs(np.polyval(np.polyfit(number, middle, 1), number) - middle).max())

    assert bend(frame) > bent
    assert bend(flat) < 0.5


def test_only_motion_is_blurred(straight: Ground) -> None:
    sharp = CAMERAS["donkey"]
    blurred = Camera(replace(sharp, exposure=1 / 60), LOOK)
    still = blurred.render(straight, pose(127.0, 40.0, math.pi / 2)).astype(float)
    turning = blurred.render(straight, pose(127.0, 40.0, math.pi / 2, yaw_rate=1.0)).astype(float)
    # 1 rad/s during 1/60 s is 2.5 px.
    edges_still, edges_turning = ((np.diff(f[80:100, 165:], axis=1) ** 2).sum() for f in (still, turning))
    assert edges_turning < 0.95 * edges_still
    assert np.abs(still - Camera(sharp, LOOK).render(straight, pose(127.0, 40.0, math.pi / 2))).mean() < 1.0


def test_the_skyline_stays_on_the_horizon_and_turns_with_yaw(straight: Ground) -> None:
    """The skyline changes only sky rows; a turn by the angle of one pixel shifts it by one pixel."""
    spec = CAMERAS["bullet"]
    bare, hills = (Camera(spec, replace(LOOK, hills=h)) for h in (0.0, 5.0))
    vehicle = pose(127.0, 40.0, 1.0)
    row = horizon_row(spec)
    a, b = bare.render(straight, vehicle), hills.render(straight, vehicle)
    assert np.array_equal(a[row + 3 :], b[row + 3 :])
    assert np.abs(a[row - 8 : row].astype(int) - b[row - 8 : row]).mean() > 10.0
    turned = hills.render(straight, replace(vehicle, yaw=1.0 + 10 / spec.intrinsics[0, 0])).astype(int)
    errors = [np.abs(turned[: row - 2, 140 + s : 180 + s] - b[: row - 2, 140:180]).mean() for s in range(21)]
    assert int(np.argmin(errors)) == pytest.approx(10, abs=1)


@pytest.fixture(scope="module")
def run() -> RunRecord:
    """Forty frames on a straight road, ever more to the right."""
    session = Session(make_simulator("donkey"))
    session.start(Scenario(STRAIGHT, seed=3))
    for step in range(40):
        session.advance(Command(0.004 * step, 0.8))
    session.simulator.close()
    assert session.run is not None
    return session.run


def test_a_video_has_every_frame_and_shows_the_drive(tmp_path: Path, run: RunRecord) -> None:
    write_video(tmp_path / "run.mp4", "donkey", STRAIGHT, resimulate(DONKEY, run), run.commands)
    assert [p.name for p in tmp_path.iterdir()] == ["run.mp4"]
    video = cv2.VideoCapture(str(tmp_path / "run.mp4"))
    assert video.get(cv2.CAP_PROP_FPS) == 20.0
    frames = []
    while (got := video.read())[0]:
        frames.append(got[1][..., ::-1].astype(float))
    assert len(frames) == 41 + 20 and frames[0].shape == (480, 1260, 3)
    # The camera's last image, as the simulator gave it.
    image = [o.image for o in resimulate(DONKEY, run)][-1]
    shown = cv2.resize(frames[40][:, :960], (320, 160), interpolation=cv2.INTER_AREA)
    assert np.abs(shown - image).mean() < 6.0
    # The trail on the map, grows.
    trail = [int(((f[28:308, 970:1250] - rgb(SERIES[2])) ** 2).sum(axis=2).__lt__(60**2).sum()) for f in frames]
    assert trail[40] > trail[5] + 10


@pytest.mark.parametrize(("lane_width", "full"), [(3.0, True), (4.0, False)])
def test_the_gauge_of_the_lateral_position_ends_at_the_edge_of_the_lane(
    tmp_path: Path, run: RunRecord, lane_width: float, full: bool
) -> None:
    seen = next(resimulate(DONKEY, run))
    seen = replace(seen, lane=replace(seen.lane, lateral_position=1.5))
    write_video(tmp_path / "run.mp4", "donkey", replace(STRAIGHT, lane_width=lane_width), [seen], [])
    frame = cv2.VideoCapture(str(tmp_path / "run.mp4")).read()[1][..., ::-1].astype(float)
    assert (np.abs(frame[366, 960 + 208] - rgb(PASS)).max() < 60.0) == full


def test_a_bad_place_for_a_video_is_named(tmp_path: Path) -> None:
    with pytest.raises(VideoError, match="ends with .mp4"):
        check_path(tmp_path / "run.avi")
    with pytest.raises(VideoError, match="is not a folder"):
        check_path(tmp_path / "none" / "run.mp4")
