# SPDX-License-Identifier: Apache-2.0
import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from ds_recording.chessboard import calibrate, parse_board
from ds_recording.errors import RecordingError
from ds_recording.floor_camera import FloorCamera, read_camera, write_camera

CAMERA = FloorCamera(
    width_px=160, height_px=120, focal_px=80.0, centre_x_px=79.5, centre_y_px=59.5, height_m=0.2, pitch_rad=0.3,
    forward_m=0.05,
)  # fmt: skip
LENS = (-0.2, 0.03, 0.001, -0.002, 0.0)


def test_the_optical_axis_meets_the_floor_where_trigonometry_says() -> None:
    floor, valid = CAMERA.floor(np.array([[79.5, 59.5], [79.5, 20.0]]))
    np.testing.assert_allclose(floor[0], (0.05 + 0.2 / math.tan(0.3), 0.0), atol=1e-12)
    assert valid.tolist() == [True, False]  # the second looks above the horizon


def test_left_of_the_car_is_left_in_the_image() -> None:
    pixels, _ = CAMERA.project(np.array([[1.0, 0.2], [1.0, -0.2]]))
    assert pixels[0, 0] < 79.5 < pixels[1, 0]


@pytest.mark.parametrize("lens", [(0.0,) * 5, LENS])
def test_a_point_of_the_floor_comes_back_from_its_pixel(lens: tuple[float, ...]) -> None:
    camera = replace(CAMERA, distortion=lens)
    points = np.array([[0.5, 0.1], [1.0, -0.4], [3.0, 1.0]])
    pixels, _ = camera.project(points)
    found, valid = camera.floor(pixels)
    assert valid.all()
    np.testing.assert_allclose(found, points, atol=2e-4)


def test_an_image_of_another_size_shows_the_same_floor() -> None:
    large = CAMERA.resized(320, 240)
    np.testing.assert_allclose(large.floor(np.array([[159.5, 119.5]]))[0], CAMERA.floor(np.array([[79.5, 59.5]]))[0])


def test_a_camera_file_is_read_as_it_was_written(tmp_path: Path) -> None:
    for camera in (CAMERA, replace(CAMERA, height_m=None, pitch_rad=None, distortion=LENS)):
        write_camera(tmp_path / "camera.yaml", camera)
        assert read_camera(tmp_path / "camera.yaml") == camera


@pytest.mark.parametrize(
    ("line", "wrong"),
    [
        ("focal_px: .nan", "focal_px is nan, expected a number from 1"),
        ("focal_px: true", "focal_px is True"),
        ("height_m: -1", "height_m is -1"),
        ("distortion: [1, 2]", "expected five numbers"),
        ("secret: 1", "expected the keys"),
        ("focal_px: [", "camera.yaml: line"),
    ],
)
def test_a_bad_camera_file_is_refused_in_one_line(tmp_path: Path, line: str, wrong: str) -> None:
    write_camera(tmp_path / "camera.yaml", CAMERA)
    key = line.partition(":")[0]
    kept = [row for row in (tmp_path / "camera.yaml").read_text().splitlines() if not row.startswith(key)]
    (tmp_path / "camera.yaml").write_text("\n".join([*kept, line]))
    with pytest.raises(RecordingError, match="camera.yaml") as error:
        read_camera(tmp_path / "camera.yaml")
    assert wrong in str(error.value) and "\n" not in str(error.value)


def board_picture(rotation: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Chessboard of 8 x 6 squares of 25 mm, seen by a pinhole of 300 px."""
    squares = np.full((360, 480), 255, np.uint8)
    for row in range(6):
        for column in range(8):
            if (row + column) % 2:
                squares[row * 40 + 60 : row * 40 + 100, column * 40 + 80 : column * 40 + 120] = 0
    matrix = np.array([[300.0, 0, 159.5], [0, 300.0, 119.5], [0, 0, 1]])
    metres = np.array([[0.025 / 40, 0, -0.15], [0, 0.025 / 40, -0.1125], [0, 0, 1]])
    pose = np.column_stack((rotation[:, 0], rotation[:, 1], shift))
    larger = np.array([[4.0, 0, 1.5], [0, 4.0, 1.5], [0, 0, 1]])
    seen = cv2.warpPerspective(squares, larger @ matrix @ pose @ metres, (1280, 960), borderValue=255)
    return np.asarray(cv2.resize(seen, (320, 240), interpolation=cv2.INTER_AREA))


def test_a_chessboard_tells_the_focal_length(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    paths = []
    for index in range(10):
        turned, _ = cv2.Rodrigues(rng.uniform(-0.6, 0.6, 3))
        paths.append(tmp_path / f"{index}.png")
        cv2.imwrite(str(paths[-1]), board_picture(turned, np.array([*rng.uniform(-0.02, 0.02, 2), 0.3])))
    camera, error, boards = calibrate(paths, parse_board("8x6"), 0.025)
    assert boards >= 6 and error < 0.5
    assert camera.focal_px == pytest.approx(300.0, rel=0.03)
    assert not camera.mounted


def test_photographs_without_a_board_are_refused(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((60, 80), np.uint8))
    with pytest.raises(RecordingError, match="found in 0 of 1"):
        calibrate([tmp_path / "a.png"], (7, 5), 0.025)
    with pytest.raises(RecordingError, match="--squares is '8'"):
        parse_board("8")
