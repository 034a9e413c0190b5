# SPDX-License-Identifier: Apache-2.0
"""Calibrates a camera with photographs of a chessboard (OpenCV)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_base.bounded_file import FileError, read_regular
from ds_base.progress import counted
from ds_driver.networks.images import ImageError, rgb_of_file
from ds_recording import RecordingError
from ds_recording.floor_camera import MODELS as COEFFICIENTS
from ds_recording.floor_camera import FloorCamera, Lens

Array = NDArray[Any]

SUFFIXES = (".jpg", ".jpeg", ".png")
LEAST_BOARDS = 6
"""Photographs in which the board must be found; chosen: fewer leave focal length and distance undecided."""
MOST_IMAGES, MAX_FILE = 200, 2**26
_FISHEYE: Any = cv2 if hasattr(cv2, "CALIB_RECOMPUTE_EXTRINSIC") else cv2.fisheye  # OpenCV 5, and 4
MODELS = (
    ("plumb_bob", cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST),
    ("equidistant", _FISHEYE.CALIB_RECOMPUTE_EXTRINSIC | _FISHEYE.CALIB_FIX_SKEW),
    ("plumb_bob", 0),
    ("rational_polynomial", cv2.CALIB_RATIONAL_MODEL),
)
"""Lenses to try and OpenCV's flags, in the order of their number of terms: 2, 4, 5, 8."""
FOLDS, SIMPLER = 5, 1.05
"""Parts of the boards that are held out in turn, and the factor on the least error of held-out boards within which a
lens with fewer terms is taken: terms that the boards do not need fit their noise, and bend the image elsewhere."""
WORST_ERROR, WORST_BIAS = 1.5e-3, 5e-4
"""Largest root mean square of held-out corners, and of what corners in one place of the image are off on average, as
shares of the image's width: 1 px and 0.3 px of 640. Chosen: good calibrations have a third of both."""
CELLS, ENOUGH = (8, 6), 8
"""Places of the image that are looked at, and corners that tell about one."""
LARGEST_STD = 0.03
"""Largest standard deviation of a focal length over its value; chosen: upright boards leave more."""


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """A calibrated camera, and how well its lens explains the boards."""

    camera: FloorCamera  # height and pitch are unknown
    boards: int
    rms_px: float  # root mean square of the corners' errors
    held_out_px: float  # the same of boards that the camera was not fitted to
    bias_px: float  # root mean square of what corners in one place of the image are off on average, beyond chance


def parse_board(squares: str) -> tuple[int, int]:
    """Inner corners along and across a board from its squares, such as `8x6`."""
    columns, _, rows = squares.lower().partition("x")
    if not (columns.isdecimal() and rows.isdecimal() and 4 <= int(columns) <= 50 and 4 <= int(rows) <= 50):
        raise RecordingError(f"--squares is {squares!r}, expected the board's squares, 4 to 50 each way, such as 8x6")
    return int(columns) - 1, int(rows) - 1


def images_of(paths: Sequence[Path]) -> list[Path]:
    """Images, and those in folders, in order."""
    files: list[Path] = []
    for path in paths:
        if path.is_dir():
            files += sorted(p for p in path.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith("."))
        else:
            files.append(path)
    return files[:MOST_IMAGES]


class _Fit(NamedTuple):
    """A lens fitted to boards: its name, OpenCV's matrix and coefficients."""

    model: str
    matrix: Array
    lens: Array

    def errors(self, grid: Array, places: Array) -> Array:
        """Errors of a board's corners at its best pose, (n, 2) px; cv2.error if the lens maps them to no direction."""
        if self.model == "equidistant":
            slopes = cv2.fisheye.undistortPoints(places, self.matrix, self.lens)
            _, turn, shift = cv2.solvePnP(grid, slopes, np.eye(3), np.zeros(4))
            back, _ = cv2.fisheye.projectPoints(grid[:, None].astype(np.float64), turn, shift, self.matrix, self.lens)
        else:
            _, turn, shift = cv2.solvePnP(grid, places, self.matrix, self.lens)
            back, _ = cv2.projectPoints(grid, turn, shift, self.matrix, self.lens)
        return np.asarray(back.reshape(-1, 2) - places.reshape(-1, 2), np.float64)


def calibrate(paths: Sequence[Path], corners: tuple[int, int], size: float) -> Calibration:
    """Estimate focal lengths, centre and distortion, with the lens that best explains boards that were held out.

    The board has so many inner corners along and across, and squares with sides of `size` m. RecordingError if a
    photograph cannot be read, the board is found in too few, or no lens explains them.
    """
    grid = np.zeros((corners[0] * corners[1], 3), np.float32)
    grid[:, :2] = size * np.mgrid[0 : corners[0], 0 : corners[1]].T.reshape(-1, 2)
    boards, (rows, columns) = _find_boards(paths, corners)
    parts = [range(first, len(boards), FOLDS) for first in range(FOLDS)]
    tried: list[tuple[float, str, int, list[_Fit]]] = []
    for model, flags in MODELS:
        with suppress(*([cv2.error] if model == "equidistant" else [])):  # raised for boards that no fisheye shows
            fits, errors = [], []
            for part in parts:
                kept = [board for index, board in enumerate(boards) if index not in part]
                fits.append(_fit(model, flags, grid, kept, (columns, rows)))
                errors += [fits[-1].errors(grid, boards[index]) for index in part]
            tried.append((_rms(np.concatenate(errors)), model, flags, fits))
    least = min((one[0] for one in tried), default=np.inf)
    held_out, model, flags, fits = next(one for one in tried if one[0] <= SIMPLER * least)
    fit = _fit(model, flags, grid, boards, (columns, rows))
    residuals = np.concatenate([fit.errors(grid, board) for board in boards])
    bias, where = _bias(np.concatenate(boards).reshape(-1, 2), residuals, (columns, rows))
    # Delete-a-group jackknife: it needs no lens that is right, and no independent corners.
    focal = np.array([[one.matrix[0, 0], one.matrix[1, 1]] for one in fits])
    std = np.sqrt((FOLDS - 1) / FOLDS * np.square(focal - focal.mean(axis=0)).sum(axis=0))
    problem, most = "", (WORST_ERROR * columns, WORST_BIAS * columns)
    if held_out > most[0]:
        problem = f"the corners of held-out boards are {held_out:.1f} px off, expected at most {most[0]:.1f}"
    elif bias > most[1]:
        problem = f"corners {where} are {bias:.2f} px off on average, expected at most {most[1]:.2f}"
    if problem:
        raise RecordingError(
            f"no lens explains the photographs: with the best, {model}, {problem}: check --squares, keep the board "
            "flat, hold still, and use photographs that nothing has cropped or straightened"
        )
    if (std > LARGEST_STD * focal.mean(axis=0)).any():
        raise RecordingError(
            f"the boards leave the focal lengths uncertain by {std.max():.0f} px: tilt them in different directions"
        )
    camera = FloorCamera(
        width_px=columns,
        height_px=rows,
        focal_px=(float(fit.matrix[0, 0]), float(fit.matrix[1, 1])),
        centre_x_px=float(fit.matrix[0, 2]),
        centre_y_px=float(fit.matrix[1, 2]),
        lens=Lens(model, tuple(map(float, np.ravel(fit.lens)[: COEFFICIENTS[model]]))),
        focal_std=float(std.max()),
    )
    return Calibration(camera=camera, boards=len(boards), rms_px=_rms(residuals), held_out_px=held_out, bias_px=bias)


def _find_boards(paths: Sequence[Path], corners: tuple[int, int]) -> tuple[list[Array], tuple[int, int]]:
    """Corners of each board that is found, (n, 1, 2) px, and rows and columns of the photographs."""
    boards: list[Any] = []
    shape = (0, 0)
    for path in counted(paths, "photographs of the board"):
        try:
            image = rgb_of_file(read_regular(path, MAX_FILE))
        except (OSError, FileError, ImageError) as error:
            raise RecordingError(
                f"{path}: {getattr(error, 'strerror', None) or error}: give JPEG or PNG files"
            ) from None
        if boards and image.shape[:2] != shape:
            raise RecordingError(f"{path}: another size than the photographs before: take all with the same settings")
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        has_board, places = cv2.findChessboardCornersSB(grey, corners, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
        if has_board:
            boards.append(places.reshape(-1, 1, 2).astype(np.float32))
            shape = image.shape[:2]
    if len(boards) < LEAST_BOARDS:
        raise RecordingError(
            f"a board of {corners[0] + 1} x {corners[1] + 1} squares is found in {len(boards)} of {len(paths)} "
            f"photographs, expected at least {LEAST_BOARDS}: show all of it, tilted differently, with a white border"
        )
    return boards, (shape[0], shape[1])


def _fit(model: str, flags: int, grid: Array, boards: Sequence[Array], size: tuple[int, int]) -> _Fit:
    """Fit a lens to boards; cv2.error if it cannot be fitted."""
    start = np.array([[size[0], 0, (size[0] - 1) / 2], [0, size[0], (size[1] - 1) / 2], [0, 0, 1.0]])
    if model == "equidistant":
        points = [grid[None].astype(np.float64)] * len(boards)
        places = [board.reshape(1, -1, 2).astype(np.float64) for board in boards]
        _, matrix, lens, _, _ = cv2.fisheye.calibrate(points, places, size, start, np.zeros((4, 1)), flags=flags)
    else:
        flags |= cv2.CALIB_USE_INTRINSIC_GUESS
        _, matrix, lens, _, _ = cv2.calibrateCamera([grid] * len(boards), boards, size, start, np.zeros(8), flags=flags)
    if not (np.isfinite(matrix).all() and np.isfinite(lens).all()):
        raise cv2.error("not finite")
    return _Fit(model, np.asarray(matrix), np.asarray(lens))


def _rms(errors: Array) -> float:
    """Root mean square of errors, (n, 2)."""
    return float(np.sqrt(np.square(errors).sum(axis=1).mean()))


def _bias(places: Array, errors: Array, size: tuple[int, int]) -> tuple[float, str]:
    """Root mean square of the mean errors in the places of the image, beyond chance, px, and where they are largest."""
    cells = (places / size * CELLS).astype(int).clip(0, np.array(CELLS) - 1) @ np.array([CELLS[1], 1])
    squares, largest, where = [], -1.0, ""
    for cell in np.unique(cells):
        inside = errors[cells == cell]
        if len(inside) >= ENOUGH:
            square = float(np.square(inside.mean(axis=0)).sum() - inside.var(axis=0, ddof=1).sum() / len(inside))
            squares.append(square)
            if square > largest:
                middle = places[cells == cell].mean(axis=0)
                largest, where = square, f"near column {middle[0]:.0f}, row {middle[1]:.0f}"
    return math.sqrt(max(sum(squares) / len(squares), 0.0)) if squares else 0.0, where
