# SPDX-License-Identifier: Apache-2.0
"""Calibrates a camera: its lens by photographs of a chessboard (OpenCV), its height and pitch by lines of the road."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.sparse import lil_matrix

from ds_base.bounded_file import FileError, read_regular
from ds_base.progress import counted
from ds_driver.networks.images import ImageError, rgb_of_file
from ds_recording import RecordingError
from ds_recording.first_guess import arc_offsets, candidate_shapes
from ds_recording.floor_camera import MODELS as COEFFICIENTS
from ds_recording.floor_camera import FloorCamera, Lens
from ds_recording.lines import FARTHEST, line_pixels, points_on_floor
from ds_recording.recording import Views

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


Reals = NDArray[np.float64]
Found = tuple[Reals, Reals, NDArray[np.bool_]]
HORIZONS = (0.1, 0.2, 0.3, 0.4, 0.5)
"""Rows of the horizon that are tried, shares of the image's height."""
HEIGHTS = (0.22, 0.33, 0.5, 0.75, 1.1)
"""Heights that are tried, lane widths."""
LEAST_IMAGES = 8
LEAST_SHARE = 0.4
"""Share of the line points that must agree with the best mounting."""
FAR = 4.0
"""Distance up to which points count, lane widths."""
MOST = 60
"""Points of an image that count."""
IMAGES = 24
"""Images whose lines are used."""


def mount(views: Views, camera: FloorCamera, lane_width: float) -> FloorCamera:
    """Find height and pitch of a camera, for images of the recorded size, whose lens is known."""
    rows, columns = views.images[0].shape[:2]
    chosen = np.linspace(0, len(views.images) - 1, IMAGES + 2)[1:-1].round().astype(int).tolist()
    lines = [line_pixels(views.images[index], rows // 3, views.centre) for index in chosen]
    mounted_camera = mounted(camera.resized(columns, rows).scaled(1.0 / lane_width), lines)
    return replace(camera, height_m=(mounted_camera.height_m or 1.0) * lane_width, pitch_rad=mounted_camera.pitch_rad)


def mounted(camera: FloorCamera, lines: Sequence[Found]) -> FloorCamera:
    """Estimate height and pitch from the lines of some images, in lane widths; what is known already stays."""
    lines = [of_image for of_image in lines if (~of_image[2]).sum() >= 4 and of_image[2].sum() >= 4]
    if len(lines) < LEAST_IMAGES:
        raise RecordingError(
            f"only {len(lines)} of the chosen images show coloured and white lines, expected {LEAST_IMAGES}: measure "
            "height and pitch of the camera, and write them into its file"
        )
    best: tuple[float, FloorCamera, list[Reals]] | None = None
    total = sum(min(len(of_image[0]), MOST) for of_image in lines)
    for horizon in HORIZONS:
        pitch = math.atan((camera.centre_y_px - horizon * camera.height_px) / camera.focal_px[1])
        for height in HEIGHTS:
            tried = replace(camera, height_m=camera.height_m or height, pitch_rad=camera.pitch_rad or pitch)
            shapes, votes = [], 0.0
            for of_image in lines:
                points = points_on_floor(of_image, tried)
                near = points.floor[:, 0] < FAR
                shape = candidate_shapes(points.floor[near], points.white[near])[:1]
                shapes.append(shape[0, :3] if len(shape) else np.zeros(3))
                votes += min(float(shape[0, 3]), float(MOST)) if len(shape) else 0.0
            if best is None or votes / total > best[0]:
                best = votes / total, tried, shapes
    assert best is not None
    if best[0] < LEAST_SHARE:
        raise RecordingError(
            f"{best[0]:.0%} of the line points agree with any height and pitch of the camera, expected "
            f"{LEAST_SHARE:.0%}: calibrate with a chessboard, and measure height and pitch"
        )
    return _refined(best[1], lines, np.array(best[2]), (camera.height_m, camera.pitch_rad))


def _refined(
    camera: FloorCamera, lines: Sequence[Found], shapes: Reals, fixed: tuple[float | None, float | None]
) -> FloorCamera:
    """Least squares over height, pitch and the shape of the road in every image."""
    counts = [min(len(points[0]), MOST) for points in lines]
    chosen = [np.linspace(0, len(points[0]) - 1, n).astype(int) for points, n in zip(lines, counts, strict=True)]
    pixels = np.concatenate([points[0][index] for points, index in zip(lines, chosen, strict=True)])
    white = np.concatenate([points[2][index] for points, index in zip(lines, chosen, strict=True)])
    image = np.repeat(np.arange(len(lines)), counts)

    def at(values: Reals) -> FloorCamera:
        height = fixed[0] or math.exp(float(np.clip(values[0], -4.0, 4.0)))
        return replace(
            camera, height_m=height, pitch_rad=float(np.clip(values[1], -0.3, 1.3)) if fixed[1] is None else fixed[1]
        )

    def errors(values: Reals) -> Reals:
        """Errors of all points in pixels, and weak expectations of the shapes."""
        now, shape = at(values), values[2:].reshape(-1, 3)
        floor, valid = now.floor(pixels)
        left = np.concatenate(
            [arc_offsets(floor[image == i], shape[i : i + 1, 1], shape[i : i + 1, 2])[0] for i in range(len(lines))]
        )
        error = left - shape[image, 0]
        error = np.where(white, np.where(error > 0.0, error - 1.0, error + 1.0), error)
        # One pixel across is so wide on the floor.
        size = np.hypot(np.maximum(floor[:, 0], 0.1), now.height_m or 1.0) / now.focal_px[0] + 0.005
        weak = np.concatenate((shape[:, 1] / 0.5, shape[:, 2] / 0.4))
        used = valid & (floor[:, 0] < FARTHEST)
        return np.concatenate((np.where(used, np.clip(error / size, -100.0, 100.0), 8.0), weak))

    pattern = lil_matrix((len(pixels) + 2 * len(lines), 2 + 3 * len(lines)), dtype=int)
    pattern[: len(pixels), :2] = 1
    every = np.arange(len(lines))
    for i in range(3):
        pattern[np.arange(len(pixels)), 2 + 3 * image + i] = 1
    for i in range(2):
        pattern[len(pixels) + i * len(lines) + every, 3 + i + 3 * every] = 1
    start = np.concatenate(([math.log(camera.height_m or 1.0), camera.pitch_rad or 0.0], shapes.ravel()))
    solved = least_squares(errors, start, jac_sparsity=pattern, loss="cauchy", f_scale=1.5, max_nfev=40, x_scale=0.1)
    return at(solved.x)
