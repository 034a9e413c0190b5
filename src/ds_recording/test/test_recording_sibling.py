# SPDX-License-Identifier: Apache-2.0
"""A recording as a simulator: what it shows elsewhere, does not know, and refuses; and its camera, by trigonometry.

The recording is made here: a floor whose colour is a closed form of the place, seen by a pinhole on a bent road.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from floor_cameras import floor_camera
from numpy.typing import NDArray
from tubs import write_tub

from ds_recording import RecordingError
from ds_recording.chessboard import calibrate, parse_board
from ds_recording.floor_camera import FloorCamera, Lens, read_camera, write_camera
from ds_recording.located import COLUMNS
from ds_recording.sibling.recorded_drive import read_drive, sections
from ds_recording.sibling.simulator import PhotoScene, RecordingSimulator, network_grid
from ds_road import Road, RoadError
from ds_sim.scenario import Scenario
from ds_sim.session import Session
from ds_sim.simulator import Command, Outcome, Reason, VehicleState

WIDTH, HEIGHT, FOCAL, HIGH, PITCH, FORWARD = 160, 120, 90.0, 0.12, 0.2, 0.04
LANE = 0.25
"""Width of a lane, m on the floor; 16 of these metres are one on the floor of the model."""
STEP = 0.04
"""Distance between two photographs, m."""


def colour(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Smooth pattern of the floor, grey levels."""
    return np.stack([127 + 100 * np.sin(6 * x), 127 + 100 * np.cos(7 * y), 127 + 100 * np.sin(4 * (x + y))], axis=-1)


def seen(x: float, y: float, yaw: float, columns: NDArray[np.float64], rows: NDArray[np.float64]) -> NDArray[np.uint8]:
    """What a pinhole sees of the floor from a pose, m on the floor; blue above the horizon."""
    right = np.broadcast_to((columns - (WIDTH - 1) / 2) / FOCAL, (len(rows), len(columns)))
    down = np.broadcast_to(((rows - (HEIGHT - 1) / 2) / FOCAL)[:, None], right.shape)
    sinks = math.sin(PITCH) + down * math.cos(PITCH)
    far = HIGH / np.maximum(sinks, 1e-3)
    ahead, left = far * (math.cos(PITCH) - down * math.sin(PITCH)) + FORWARD, -far * right
    place = x + math.cos(yaw) * ahead - math.sin(yaw) * left, y + math.sin(yaw) * ahead + math.cos(yaw) * left
    image = np.where((sinks > 0.05)[..., None], colour(*place), (40, 60, 200))
    return np.asarray(np.rint(image), np.uint8)


def way() -> list[tuple[float, float, float]]:
    """Poses of the car: straight north, then a bend to the right of 1.5 m radius, then straight."""
    poses, (x, y, yaw) = [], (5.0, 5.0, math.pi / 2)
    for k in range(160):
        poses.append((x, y, yaw))
        turn = -STEP / 1.5 if 60 <= k < 90 else 0.0
        x, y, yaw = x + STEP * math.cos(yaw + turn / 2), y + STEP * math.sin(yaw + turn / 2), yaw + turn
    return poses


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A located recording on the centre line of the right lane."""
    made = tmp_path_factory.mktemp("recording")
    (made / "tub/images").mkdir(parents=True)
    columns, rows = np.arange(float(WIDTH)), np.arange(float(HEIGHT))
    records: list[dict[str, object]] = []
    located, track = [], []
    for k, (x, y, yaw) in enumerate(way()):
        cv2.imwrite(str(made / f"tub/images/{k}.png"), seen(x, y, yaw, columns, rows)[..., ::-1])
        about = {"cam/image_array": f"{k}.png", "user/mode": "user"}
        records.append(about | {"user/angle": 0.0, "user/throttle": 0.2})
        located.append((k, 0.05 * k, x, y, yaw, STEP * k, LANE / 2, 0, 0.8, 0, 0, 0, 0, 0.2))
        track.append((x - LANE / 2 * math.sin(yaw), y + LANE / 2 * math.cos(yaw), LANE, LANE))
    write_tub(made / "tub", records)
    for name, head, lines in (("located", ",".join(COLUMNS), located), ("track", "# x_m,y_m", track)):
        (made / f"{name}.csv").write_text("\n".join([head, *(",".join(map(str, line)) for line in lines)]) + "\n")
    write_camera(made / "camera.yaml", floor_camera(FOCAL, HIGH, PITCH, forward=FORWARD))
    (made / "recording.json").write_text(json.dumps({"source": "tub", "lane_width_m": LANE}))
    return made


def pose_near(folder: Path, index: int, left: float, turn: float) -> tuple[VehicleState, tuple[float, float, float]]:
    """A pose beside a photograph, as road metres for the scene and as metres on the floor."""
    x, y, yaw = way()[index]
    x, y, yaw = x - left * math.sin(yaw), y + left * math.cos(yaw), yaw + turn
    shift = read_drive(folder).poses[index, :2] - 16.0 * np.array(way()[index][:2])
    state = VehicleState(x=16 * x + shift[0], y=16 * y + shift[1], yaw=yaw, speed=0.0, yaw_rate=0.0, steering_angle=0.0)
    return state, (x, y, yaw)


@pytest.mark.parametrize(
    ("left", "turn", "error"), [(0.0, 0.0, 0.6), (0.06, 0.0, 2.0), (0.0, 0.17, 2.0), (-0.08, -0.12, 4.0)]
)
def test_a_photograph_is_moved_as_the_floor_says(folder: Path, left: float, turn: float, error: float) -> None:
    scene = PhotoScene(read_drive(folder))
    state, place = pose_near(folder, 75, left, turn)
    found = scene.still(state)
    columns, rows = network_grid(WIDTH, HEIGHT)
    true = seen(*place, columns, rows)
    floor = rows > (HEIGHT - 1) / 2 - FOCAL * math.tan(PITCH) + 10.0  # below what aliases near the horizon
    off = np.abs(found[floor].astype(float) - true[floor])
    assert off.mean() < error and np.quantile(off, 0.95) < 8 * error
    unmoved = np.abs(scene.still(pose_near(folder, 75, 0.0, 0.0)[0])[floor].astype(float) - true[floor])
    assert left == turn == 0.0 or off.mean() < 0.2 * unmoved.mean()


def test_what_a_photograph_does_not_show_comes_from_those_behind(folder: Path) -> None:
    drive = read_drive(folder)
    scene = PhotoScene(drive)
    scene.still(pose_near(folder, 110, 0.1, 0.3)[0])
    alone = PhotoScene(drive)
    alone._chosen = lambda *pose: (110, [])  # type: ignore[method-assign]
    alone.still(pose_near(folder, 110, 0.1, 0.3)[0])
    assert scene.unseen < 0.6 * alone.unseen


@pytest.fixture
def road(folder: Path) -> Road:
    (road,) = sections(read_drive(folder), 80.0, 1000.0)
    return road


def test_it_drives_to_the_end_and_repeats_its_bytes(folder: Path, road: Road) -> None:
    simulator = RecordingSimulator.from_file(folder)
    digests = []
    for _ in range(2):
        session = Session(simulator)
        frame = session.start(Scenario(road, seed=1))
        images = 0
        while session.driving:
            assert frame is not None
            images = hash((images, frame.image.tobytes()))
            frame = session.advance(Command(float(np.clip(0.4 * -frame.lane.preview_lateral_position, -1, 1)), 0.3))
        assert session.run is not None and session.run.outcome is Outcome.COMPLETED, session.run
        digests.append(images)
    assert digests[0] == digests[1]


def test_beyond_its_photographs_it_does_not_know(folder: Path, road: Road) -> None:
    session = Session(RecordingSimulator.from_file(folder))
    session.start(Scenario(road, seed=1))
    while session.driving:
        session.advance(Command(1.0, 0.6))
    assert session.run is not None
    ended = session.run.outcome, session.run.reason
    assert ended in ((Outcome.SIM_ERROR, Reason.OUT_OF_SIGHT), (Outcome.OUT_OF_BOUNDS, Reason.NONE))
    scene = PhotoScene(read_drive(folder))
    with pytest.raises(Exception, match="does not show what it would see"):
        scene.still(pose_near(folder, 75, 0.3, 0.0)[0])


def test_only_its_own_track_is_driven(folder: Path, road: Road) -> None:
    simulator = RecordingSimulator.from_file(folder)
    for other in (road.reversed(), road.mirrored(), road.in_lane("left")):
        with pytest.raises(RoadError, match="is no section of the recorded track: make roads with"):
            simulator.load(other, seed=1)


NO_NUMBERS = ",".join(["nan"] * 14)


@pytest.mark.parametrize(
    ("name", "text", "line"),
    [
        ("recording.json", "{}", "lane_width_m in recording.json is None, expected metres"),
        ("recording.json", '{"source": "tub", "lane_width_m": 4.0}', "a lane of 4 m, expected 0.0625 to 1.25"),
        ("recording.json", '{"source": "elsewhere", "lane_width_m": 0.25}', "elsewhere: .*: put the recording there"),
        ("located.csv", "frame,x\n1,2\n", "located.csv has the columns frame,x, expected frame,time_s"),
        ("located.csv", "\n".join([",".join(COLUMNS), NO_NUMBERS, NO_NUMBERS]), "needs a row of 14 numbers"),
        ("camera.yaml", "image_width: -1\n", "camera.yaml: "),
        ("track.csv", "0,0\n", "track.csv: not a track: expected at least two lines"),
        ("simulator.yaml", "car: 3\n", "simulator.yaml: car: "),
        ("simulator.yaml", "crop_top: 500\n", "simulator.yaml: crop_top: 500, expected below 160"),
    ],
)
def test_a_broken_folder_is_one_line(folder: Path, tmp_path: Path, name: str, text: str, line: str) -> None:
    for file in folder.iterdir():
        (tmp_path / file.name).symlink_to(file)
    (tmp_path / name).unlink(missing_ok=True)
    (tmp_path / name).write_text(text)
    with pytest.raises(RecordingError, match=line) as caught:
        RecordingSimulator.from_file(tmp_path)
    assert "\n" not in str(caught.value)


CAMERA = floor_camera(80.0, 0.2, 0.3, forward=0.05)


def test_the_optical_axis_meets_the_floor_where_trigonometry_says() -> None:
    floor, valid = CAMERA.floor(np.array([[79.5, 59.5], [79.5, 20.0]]))
    np.testing.assert_allclose(floor[0], (0.05 + 0.2 / math.tan(0.3), 0.0), atol=1e-12)
    assert valid.tolist() == [True, False]  # the second looks above the horizon


LENSES = [
    Lens(),
    Lens("plumb_bob", (-0.2, 0.03, 0.001, -0.002, 0.0)),
    Lens("rational_polynomial", (0.5, 0.1, 1e-3, -2e-3, 0.02, 0.8, 0.2, 0.01)),
    Lens("equidistant", (0.02, -0.01, 0.0, 0.0)),
]


@pytest.mark.parametrize("lens", LENSES, ids=[lens.model for lens in LENSES])
def test_a_point_of_the_floor_comes_back_from_its_pixel(lens: Lens) -> None:
    camera = replace(CAMERA, lens=lens, focal_px=(80.0, 95.0))
    points = np.array([[0.5, 0.1], [1.0, -0.4], [3.0, 1.0]])
    pixels, _ = camera.project(points)
    found, valid = camera.floor(pixels)
    assert valid.all()
    np.testing.assert_allclose(found, points, atol=2e-4)


def test_an_image_of_another_size_shows_the_same_floor() -> None:
    large = CAMERA.resized(320, 240)
    np.testing.assert_allclose(large.floor(np.array([[159.5, 119.5]]))[0], CAMERA.floor(np.array([[79.5, 59.5]]))[0])


def test_a_camera_file_is_read_as_it_was_written(tmp_path: Path) -> None:
    unmounted = replace(CAMERA, height_m=None, pitch_rad=None, focal_px=(80.0, 95.5))
    for camera in (CAMERA, unmounted, *(replace(CAMERA, lens=lens) for lens in LENSES)):
        write_camera(tmp_path / "camera.yaml", camera)
        assert read_camera(tmp_path / "camera.yaml") == camera


@pytest.mark.parametrize("lens", LENSES, ids=[lens.model for lens in LENSES])
def test_lenses_are_those_of_opencv(lens: Lens) -> None:
    camera = replace(CAMERA, lens=lens, focal_px=(80.0, 95.0))
    points = np.random.default_rng(3).uniform((-0.5, -0.4, 1.0), (0.5, 0.4, 1.5), (50, 3))
    matrix = np.array([[80.0, 0, 79.5], [0, 95.0, 59.5], [0, 0, 1]])
    project = cv2.fisheye.projectPoints if lens.model == "equidistant" else cv2.projectPoints
    expected, _ = project(points[:, None], np.zeros(3), np.zeros(3), matrix, np.array(lens.coefficients))
    columns, rows, covered = camera.pixels(points[:, 0] / points[:, 2], points[:, 1] / points[:, 2])
    assert covered.all()
    np.testing.assert_allclose(np.stack((columns, rows), axis=1), expected.reshape(-1, 2), atol=1e-9)


ROS = """\
image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [400., 0.0, 320., 0.0, 410., 240., 0.0, 0.0, 1.0]
distortion_model: {model}
distortion_coefficients:
  rows: 1
  cols: {count}
  data: {data}
projection_matrix:
  rows: 3
  cols: 4
  data: [401.9, 0.0, 319.7, 0.0, 0.0, 418.1, 239.1, 0.0, 0.0, 0.0, 1.0, 0.0]
"""
OPENCV = """%YAML:1.0
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 400., 0., 320., 0., 410., 240., 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ -0.25, 0.125, 0., 0., 0. ]
"""
KALIBR = """cam0:
  camera_model: pinhole
  intrinsics: [400.0, 410.0, 320.0, 240.0]
  distortion_model: {model}
  distortion_coeffs: [-0.25, 0.125, 0.0, 0.0]
  resolution: [640, 480]
"""
BARREL = (-0.25, 0.125, 0.0, 0.0)


@pytest.mark.parametrize(
    ("text", "lens"),
    [
        (ROS.format(model="plumb_bob", count=5, data=[*BARREL, 0.0]), Lens("plumb_bob", (*BARREL, 0.0))),
        (ROS.format(model="plumb_bob", count=4, data=[*BARREL]), Lens("plumb_bob", (*BARREL, 0.0))),
        (ROS.format(model="rational_polynomial", count=8, data=[1.0] * 8), Lens("rational_polynomial", (1.0,) * 8)),
        (ROS.format(model="fisheye", count=4, data=[*BARREL]), Lens("equidistant", BARREL)),
        (OPENCV, Lens("plumb_bob", (*BARREL, 0.0))),
        (KALIBR.format(model="radtan"), Lens("plumb_bob", (*BARREL, 0.0))),
        (KALIBR.format(model="equidistant"), Lens("equidistant", BARREL)),
    ],
)
def test_camera_files_of_ros_opencv_and_kalibr_are_read(tmp_path: Path, text: str, lens: Lens) -> None:
    (tmp_path / "camera.yaml").write_text(text)
    camera = read_camera(tmp_path / "camera.yaml")
    assert (camera.width_px, camera.height_px, camera.focal_px) == (640, 480, (400.0, 410.0))
    assert (camera.centre_x_px, camera.centre_y_px, camera.lens) == (320.0, 240.0, lens) and not camera.mounted


def test_an_omnidirectional_camera_of_kalibr_is_refused(tmp_path: Path) -> None:
    (tmp_path / "camera.yaml").write_text(KALIBR.format(model="radtan").replace("pinhole", "omni"))
    with pytest.raises(RecordingError, match="distortion_model is 'omni', expected plumb_bob"):
        read_camera(tmp_path / "camera.yaml")


@pytest.mark.parametrize(
    ("line", "wrong"),
    [
        ("camera_matrix: {data: [.nan, 0, 1, 0, 1, 1, 0, 0, 1]}", "camera_matrix is nan, expected a number from"),
        ("camera_matrix: {data: [9, 1, 1, 0, 9, 1, 0, 0, 1]}", "a skew of 1"),
        ("camera_matrix: [1, 2]", "camera_matrix is [1, 2], expected data of 9 numbers"),
        ("image_width: true", "image_width is True"),
        ("height_m: -1", "height_m is -1"),
        ("distortion_coefficients: {data: [1, 2]}", "expected data of 0 or 4 or 5"),
        ("distortion_model: pinhole", "distortion_model is 'pinhole', expected plumb_bob"),
        ("camera_matrix: [", "camera.yaml: line"),
    ],
)
def test_a_bad_camera_file_is_refused_in_one_line(tmp_path: Path, line: str, wrong: str) -> None:
    write_camera(tmp_path / "camera.yaml", CAMERA)
    kept = yaml.safe_load((tmp_path / "camera.yaml").read_text())
    kept.pop(line.partition(":")[0], None)
    (tmp_path / "camera.yaml").write_text(f"{yaml.safe_dump(kept)}{line}\n")
    with pytest.raises(RecordingError, match="camera.yaml") as error:
        read_camera(tmp_path / "camera.yaml")
    assert wrong in str(error.value) and "\n" not in str(error.value)


def board_picture(camera: FloorCamera, turn: np.ndarray, shift: np.ndarray, bend: float = 0.0) -> np.ndarray:
    """Chessboard of 8 x 6 squares of 25 mm, drawn by nine rays a pixel; `bend` is the height of its arc, m."""
    rows, columns = np.mgrid[0 : 3 * camera.height_px, 0 : 3 * camera.width_px]
    pixels = (np.stack((columns.ravel(), rows.ravel()), axis=1) + 0.5) / 3 - 0.5
    slopes, covered = camera.rays(pixels)
    rays = np.column_stack((slopes, np.ones(len(slopes)))) @ turn
    origin = -shift @ turn
    depth = np.zeros(len(rays))
    for _ in range(8 if bend else 1):
        on_board = origin[:2] + depth[:, None] * rays[:, :2]
        height = bend * (1.0 - (on_board[:, 0] / 0.1) ** 2).clip(-1.0)
        depth = (height - origin[2]) / rays[:, 2]
    across, down = (origin[:2] + depth[:, None] * rays[:, :2]).T / 0.025 + np.array([[4.0], [3.0]])
    inside = np.asarray(covered, bool) & (depth > 0) & (across > 0) & (across < 8) & (down > 0) & (down < 6)
    dark = inside & ((np.floor(across) + np.floor(down)) % 2 == 0)
    drawn = np.where(dark, 20.0, 230.0).reshape(camera.height_px, 3, camera.width_px, 3).mean(axis=(1, 3))
    return np.asarray(drawn, np.uint8)


def photographs(folder: Path, camera: FloorCamera, distance: float, spread: float, bend: float = 0.0) -> list[Path]:
    rng = np.random.default_rng(1)
    paths = []
    for index in range(14):
        turned, _ = cv2.Rodrigues(np.array([*rng.uniform(-0.5, 0.5, 2), rng.uniform(-0.3, 0.3)]))
        away = distance * rng.uniform(0.8, 1.2)
        shift = np.array([*rng.uniform(-spread, spread, 2) * away, away])
        paths.append(folder / f"{index}.png")
        cv2.imwrite(str(paths[-1]), board_picture(camera, turned, shift, bend))
    return paths


TRUE = FloorCamera(width_px=400, height_px=300, focal_px=(260.0, 260.0), centre_x_px=203.0, centre_y_px=147.0)


@pytest.mark.parametrize(
    ("camera", "distance", "spread"),
    [
        (replace(TRUE, focal_px=(260.0, 346.7)), 0.32, 0.35),
        (replace(TRUE, lens=Lens("plumb_bob", (-0.3, 0.1, 0.002, -0.001, 0.0))), 0.32, 0.35),
        (replace(TRUE, focal_px=(150.0, 150.0), lens=Lens("equidistant", (0.02, -0.01, 0.0, 0.0))), 0.2, 0.8),
    ],
    ids=["pixels that are not square", "barrel", "fisheye"],
)
def test_chessboards_tell_the_camera(tmp_path: Path, camera: FloorCamera, distance: float, spread: float) -> None:
    found = calibrate(photographs(tmp_path, camera, distance, spread), parse_board("8x6"), 0.025)
    assert found.boards >= 8 and found.held_out_px < 0.4 and found.bias_px < 0.15 and not found.camera.mounted
    assert found.camera.lens.model != "plumb_bob" or camera.lens.model == "plumb_bob"
    for wanted, value in zip(camera.focal_px, found.camera.focal_px, strict=True):
        assert abs(value - wanted) < 3.0 * found.camera.focal_std < 0.06 * wanted
    # Where the axis is, boards tell badly, as turning them looks alike; the field of view they tell.
    sides = np.array([[40.0, 147.0], [360.0, 147.0], [203.0, 30.0], [203.0, 270.0]])
    views = [np.diff(np.arctan(one.rays(sides)[0]).reshape(2, 2, 2), axis=1) for one in (camera, found.camera)]
    across, down = ([view[0, 0, 0] for view in views], [view[1, 0, 1] for view in views])
    assert across[1] == pytest.approx(across[0], rel=0.025) and down[1] == pytest.approx(down[0], rel=0.025)


def test_a_chessboard_needs_nothing_that_reads_recordings() -> None:
    script = """
import sys, ds_recording.chessboard
heavy = {"rosbags", "pyarrow", "mcap", "ds_recording.recording"} & set(sys.modules)
assert not heavy, heavy
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


def test_what_no_lens_explains_is_refused(tmp_path: Path) -> None:
    """A board that is bent by 8 mm, which one free focal length once swallowed."""
    with pytest.raises(RecordingError, match="no lens explains the photographs: with the best, .*keep the board flat"):
        calibrate(photographs(tmp_path, TRUE, 0.32, 0.35, bend=0.008), parse_board("8x6"), 0.025)


def test_photographs_without_a_board_are_refused(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((60, 80), np.uint8))
    with pytest.raises(RecordingError, match="found in 0 of 1"):
        calibrate([tmp_path / "a.png"], (7, 5), 0.025)
    with pytest.raises(RecordingError, match="--squares is '8'"):
        parse_board("8")
