# SPDX-License-Identifier: Apache-2.0
"""Height and pitch of a camera above the floor, from the lines of some images: parallel, one lane width apart."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.sparse import lil_matrix

from ds_recording import RecordingError
from ds_recording.first_guess import arc_offsets, candidate_shapes
from ds_recording.floor_camera import FloorCamera
from ds_recording.lines import FARTHEST, line_pixels, points_on_floor
from ds_recording.recording import Views

Array = NDArray[np.float64]
Found = tuple[Array, Array, NDArray[np.bool_]]
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
    best: tuple[float, FloorCamera, list[Array]] | None = None
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
    camera: FloorCamera, lines: Sequence[Found], shapes: Array, fixed: tuple[float | None, float | None]
) -> FloorCamera:
    """Least squares over height, pitch and the shape of the road in every image."""
    counts = [min(len(points[0]), MOST) for points in lines]
    chosen = [np.linspace(0, len(points[0]) - 1, n).astype(int) for points, n in zip(lines, counts, strict=True)]
    pixels = np.concatenate([points[0][index] for points, index in zip(lines, chosen, strict=True)])
    white = np.concatenate([points[2][index] for points, index in zip(lines, chosen, strict=True)])
    image = np.repeat(np.arange(len(lines)), counts)

    def at(values: Array) -> FloorCamera:
        height = fixed[0] or math.exp(float(np.clip(values[0], -4.0, 4.0)))
        return replace(
            camera, height_m=height, pitch_rad=float(np.clip(values[1], -0.3, 1.3)) if fixed[1] is None else fixed[1]
        )

    def errors(values: Array) -> Array:
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
