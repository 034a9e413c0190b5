# SPDX-License-Identifier: Apache-2.0
import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from ds_recording import RecordingError
from ds_recording.calibration import calibrate, parse_board
from ds_recording.floor_camera import FloorCamera, Lens, read_camera, write_camera

CAMERA = FloorCamera(
    width_px=160,
    height_px=120,
    focal_px=(80.0, 80.0),
    centre_x_px=79.5,
    centre_y_px=59.5,
    height_m=0.2,
    pitch_rad=0.3,
    forward_m=0.05,
)
LENS = Lens("plumb_bob", (-0.2, 0.03, 0.001, -0.002, 0.0))


def test_the_optical_axis_meets_the_floor_where_trigonometry_says() -> None:
    floor, valid = CAMERA.floor(np.array([[79.5, 59.5], [79.5, 20.0]]))
    np.testing.assert_allclose(floor[0], (0.05 + 0.2 / math.tan(0.3), 0.0), atol=1e-12)
    assert valid.tolist() == [True, False]  # the second looks above the horizon


LENSES = [
    Lens(),
    LENS,
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
