# SPDX-License-Identifier: Apache-2.0
"""Calibrates a camera with photographs of a chessboard (OpenCV)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ds_base.bounded_yaml import BoundedYamlError, read_bounded
from ds_driver.networks.images import ImageError, rgb_of_file
from ds_recording.errors import RecordingError
from ds_recording.floor_camera import FloorCamera

SUFFIXES = (".jpg", ".jpeg", ".png")
LEAST_BOARDS = 6
"""Photographs in which the board must be found; chosen: fewer leave focal length and distance undecided."""
MOST_IMAGES, MAX_FILE = 200, 2**26
NEEDED = 1.5
"""Factor on the error with all terms of the lens within which k1 and k2 are enough."""
WORST_ERROR = 1.0
"""Largest root mean square of the reprojection, px; chosen: good ones have 0.1 to 0.4."""


def parse_board(squares: str) -> tuple[int, int]:
    """Inner corners along and across a board from its squares, such as `8x6`.

    Raises:
        RecordingError: it is something else.
    """
    columns, _, rows = squares.lower().partition("x")
    if not (columns.isdecimal() and rows.isdecimal() and 4 <= int(columns) <= 50 and 4 <= int(rows) <= 50):
        raise RecordingError(f"--squares is {squares!r}, expected the board's squares, 4 to 50 each way, such as 8x6")
    return int(columns) - 1, int(rows) - 1


def images_of(paths: Sequence[Path]) -> list[Path]:
    """Images, and those in folders, in order."""
    found: list[Path] = []
    for path in paths:
        if path.is_dir():
            found += sorted(p for p in path.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith("."))
        else:
            found.append(path)
    return found[:MOST_IMAGES]


def calibrate(paths: Sequence[Path], corners: tuple[int, int], size: float) -> tuple[FloorCamera, float, int]:
    """Estimate focal length, centre and distortion; height and pitch stay unknown.

    Args:
        paths: photographs, at most `MOST_IMAGES`.
        corners: inner corners along and across.
        size: side of a square, m.

    Returns:
        Camera, root mean square of the reprojection (px), and number of photographs in which the board was found.

    Raises:
        RecordingError: a photograph cannot be read, or the board is found in too few.
    """
    grid = np.zeros((corners[0] * corners[1], 3), np.float32)
    grid[:, :2] = size * np.mgrid[0 : corners[0], 0 : corners[1]].T.reshape(-1, 2)
    boards: list[Any] = []
    shape = (0, 0)
    for path in paths:
        try:
            image = rgb_of_file(read_bounded(path, MAX_FILE))
        except (OSError, BoundedYamlError, ImageError) as error:
            raise RecordingError(
                f"{path}: {getattr(error, 'strerror', None) or error}: give JPEG or PNG files"
            ) from None
        if boards and image.shape[:2] != shape:
            raise RecordingError(f"{path}: another size than the photographs before: take all with the same settings")
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        found, places = cv2.findChessboardCornersSB(grey, corners, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
        if found:
            boards.append(places.astype(np.float32))
            shape = image.shape[:2]
    if len(boards) < LEAST_BOARDS:
        raise RecordingError(
            f"a board of {corners[0] + 1} x {corners[1] + 1} squares is found in {len(boards)} of {len(paths)} "
            f"photographs, expected at least {LEAST_BOARDS}: show all of it, tilted differently, with a white border"
        )
    start = np.array([[shape[1], 0, (shape[1] - 1) / 2], [0, shape[1], (shape[0] - 1) / 2], [0, 0, 1.0]])
    usual = cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_USE_INTRINSIC_GUESS
    few, all_terms = (
        cv2.calibrateCameraExtended([grid] * len(boards), boards, shape[::-1], start.copy(), np.zeros(5), flags=flags)
        for flags in (usual | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST, usual)
    )
    # Terms that the boards do not need fit their noise, and bend the image where no board was.
    rms, matrix, lens, _, _, deviations, *_ = few if few[0] < NEEDED * all_terms[0] else all_terms
    if not np.isfinite(matrix).all() or rms > WORST_ERROR:
        raise RecordingError(
            f"the board's corners are {rms:.1f} px off in the calibrated camera, expected at most {WORST_ERROR:g}: "
            "check --squares, hold still, keep the board flat"
        )
    camera = FloorCamera(
        width_px=shape[1], height_px=shape[0], focal_px=float(matrix[0, 0]), centre_x_px=float(matrix[0, 2]),
        centre_y_px=float(matrix[1, 2]), distortion=tuple(map(float, np.ravel(lens)[:5])),
        focal_std=float(np.ravel(deviations)[:2].max()),
    )  # fmt: skip
    return camera, float(rms), len(boards)
