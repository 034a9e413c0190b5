# SPDX-License-Identifier: Apache-2.0
"""Motion of the car between two images, from corners of the floor that are seen in both.

Each corner counts along the directions in which its surroundings vary (its structure tensor): a point on a painted line
says nothing about motion along that line. What a motion of the floor does not explain is left out (gating), and the
covariance of what remains says how much is known.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_recording.floor_camera import FloorCamera
from ds_recording.hints import NOTHING, Hint

Array = NDArray[np.float64]
CORNERS = 150
"""Corners that are followed; chosen: a picture of 160 x 120 has hardly more."""
FARTHEST = 4.0
"""Distance of the farthest corners, lane widths; chosen: beyond, texture is finer than pixels and does not move."""
WINDOW = 7
"""Side of the window around a corner, px; chosen: within it what is nearer moves more than what is farther, which
shortens the motion by 2% (by 3% with 11 px, 9 to 14% with 21), and smaller ones hold too little."""
NOISE = 0.12
"""Error of a followed corner of full contrast, px; chosen on simulated recordings of 160 x 120."""
LEAST_POINTS, LEAST_SHARE = 8, 0.35
"""Corners that must agree with one motion, and their share; chosen: fewer agree by chance."""
SPEEDS, DOUBT = (0.0, 0.7, 1.4, 2.8), 25
"""Speeds that are tried where none is known (lane widths/s), and images after which one is doubted."""
CONTRADICTS = 3.0
"""Standard deviations from what else is known beyond which a motion is wrong: lines along the way seem to rest."""
GATE = 2.5
"""Residual beyond which a corner counts as an outlier, standard deviations."""


@dataclass(frozen=True, slots=True)
class Motion:
    """Motion of the car's centre, in the axes of the first image."""

    step: Array  # ahead, left, turned to the left: lane widths, lane widths, rad, (3,)
    covariance: Array  # (3, 3)
    corners: int  # that agree with it


class MotionFinder:
    """Follows the floor from image to image; the camera's unit of length is a lane width."""

    def __init__(self, camera: FloorCamera) -> None:
        self._camera = camera
        self._previous: NDArray[np.uint8] | None = None
        rows, columns = np.mgrid[0 : camera.height_px, 0 : camera.width_px]
        floor, valid = camera.floor(np.stack((columns.ravel(), rows.ravel()), axis=1).astype(float))
        near = valid & (floor[:, 0] < FARTHEST) & (np.abs(floor[:, 1]) < FARTHEST)
        self._mask = (near.reshape(rows.shape) * 255).astype(np.uint8)
        self._step = np.zeros(3)
        self._lost, self._images = True, 0

    def see(self, image: NDArray[np.uint8], seconds: float, hint: Hint = NOTHING) -> Motion | None:
        """Motion since the last image, (rows, columns, 3) uint8 RGB; None for the first, or if it is not seen.

        `seconds` is the time since the last one, `hint` what is known otherwise about the motion.
        """
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
        before, self._previous = self._previous, grey
        if before is None or seconds <= 0.0:
            return None
        # Far corners hardly move, so a search from too slow a guess finds a standstill: now and then all are tried.
        guesses = [self._step * min(seconds, 0.3)]
        if not np.isfinite(hint.std[0]) and (self._lost or self._images % DOUBT == 0):
            guesses += [np.array([speed * min(seconds, 0.3), 0.0, 0.0]) for speed in SPEEDS]
        self._images += 1
        guesses = [hint.of(guess) for guess in guesses]
        tried = [fitted for guess in guesses if (fitted := self._between(before, grey, guess, hint)) is not None]
        fitted = max(tried, key=lambda motion: motion.corners, default=None)
        # Lost, or just found: the next image is searched anew.
        self._lost = fitted is None or (self._lost and self._images % 4 != 0)
        if fitted is not None:
            self._step = fitted.step / seconds
        return fitted

    def _between(self, before: NDArray[np.uint8], after: NDArray[np.uint8], guess: Array, hint: Hint) -> Motion | None:
        corners = cv2.goodFeaturesToTrack(before, CORNERS, 0.005, 3, mask=self._mask, blockSize=5)
        if corners is None or len(corners) < LEAST_POINTS:
            return None
        start = corners.reshape(-1, 2).astype(np.float32)
        floor, _ = self._camera.floor(start.astype(float))
        tensor = cv2.cornerEigenValsAndVecs(before, WINDOW, 3)[start[:, 1].astype(int), start[:, 0].astype(int)]
        precision = _precision(tensor.astype(float))
        best: Motion | None = None
        # Coarsely, then from where the first motion puts the corners: in the large windows of a pyramid what is near
        # is held back by what is far.
        for levels in (2, 0):
            expected, covered = self._camera.project(moved(floor, guess))
            ahead = np.where(covered[:, None], expected, start).astype(np.float32)
            options: Any = {"winSize": (WINDOW, WINDOW), "maxLevel": levels, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
            end, there, _ = cv2.calcOpticalFlowPyrLK(before, after, start, ahead.copy(), **options)
            back, again, _ = cv2.calcOpticalFlowPyrLK(after, before, end, start.copy(), **options)
            kept = (there.ravel() > 0) & (again.ravel() > 0) & (np.hypot(*(back - start).T) < 0.7)
            if kept.sum() < LEAST_POINTS:
                return None
            best = self._fit(floor[kept], end[kept].astype(float), precision[kept], guess, hint)
            if best is None:
                return None
            guess = best.step
        return best

    def _fit(self, floor: Array, places: Array, precision: Array, guess: Array, hint: Hint) -> Motion | None:
        """Robust Gauss-Newton over three numbers, in pixels of the second image."""
        step = guess.copy()
        weights = np.ones(len(floor))
        normal = np.eye(3)
        for turn in range(12):
            pixels, valid = self._camera.project(moved(floor, step))
            slopes = np.stack(
                [(self._camera.project(moved(floor, step + e))[0] - pixels) / 1e-4 for e in 1e-4 * np.eye(3)], axis=2
            )
            valid &= np.isfinite(slopes).all(axis=(1, 2))
            off = np.einsum("nij,nj->ni", precision, np.where(valid[:, None], places - pixels, 0.0))
            slopes = np.einsum("nij,njk->nik", precision, np.where(valid[:, None, None], slopes, 0.0))
            size = np.hypot(*off.T)
            # Annealed Geman-McClure: from all points to those within the gate.
            scale = GATE * max(1.0, 16.0 * 0.5**turn)
            weights = np.where(valid, 1.0 / (1.0 + (size / scale) ** 2) ** 2, 0.0)
            normal = np.einsum("n,nki,nkj->ij", weights, slopes, slopes) + np.diag(1e-9 + hint.information)
            pull = np.einsum("n,nki,nk->i", weights, slopes, off) + hint.information * (hint.step - step)
            change = np.linalg.solve(normal, pull)
            step = step + change
            if turn > 4 and np.abs(change).max() < 1e-5:
                break
        agree = size[valid] < GATE
        if (
            agree.sum() < LEAST_POINTS
            or agree.mean() < LEAST_SHARE
            or abs(step[2]) > 0.6
            or (np.abs(step - hint.step) > CONTRADICTS * hint.std).any()
            or not np.isfinite(step).all()
        ):
            return None
        inflated = max(1.0, float((size[valid][agree] ** 2).mean()))
        return Motion(step, np.asarray(np.linalg.inv(normal) * inflated), int(agree.sum()))


def moved(points: Array, step: Array) -> Array:
    """Points of the floor, (n, 2), in the axes of the car after a motion (ahead, left, turned)."""
    cos, sin = np.cos(step[2]), np.sin(step[2])
    x, y = points[:, 0] - step[0], points[:, 1] - step[1]
    return np.stack((cos * x + sin * y, cos * y - sin * x), axis=1)


def _precision(tensor: Array) -> Array:
    """Square roots of the inverse covariances of followed corners, 1/px, (n, 2, 2), from eigenvalues and vectors."""
    strong, weak = tensor[:, 0], np.maximum(tensor[:, 1], 0.0)
    top = np.quantile(strong, 0.9) + 1e-12
    sizes = np.stack([np.sqrt(np.minimum(value / top, 1.0)) / NOISE for value in (strong, weak)], axis=1)
    vectors = tensor[:, 2:].reshape(-1, 2, 2)
    return np.einsum("ni,nij,nik->njk", sizes, vectors, vectors)
