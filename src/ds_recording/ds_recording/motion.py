# SPDX-License-Identifier: Apache-2.0
"""Motion of the car between two images: from whole parts of both, then from corners of the floor that are seen in both.

The floor of many a room is bare where the car is, and a hard turn blurs it. Whatever is far away moves sideways by the
turn alone: a point at distance r, seen at an angle a beside the way, moves by a share `sin(a) / r` of the way besides,
to opposite sides on the left and on the right.

Each corner counts along the directions in which its surroundings vary (its structure tensor): a point on a painted line
says nothing about motion along that line. What a motion of the floor does not explain is left out (gating), and the
covariance of what remains says how much is known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_recording.floor_camera import FloorCamera

Array = NDArray[np.float64]
WIDTH_SHARE = 0.85
"""Share of the camera's field of view that is compared; chosen: at its edges lenses are known least."""
LARGEST_TURN = 0.25
"""Largest turn between two images, rad; chosen: 5 rad/s at 20 Hz, more than a car turns."""
LOWEST = 0.02
"""Lowest angle above the horizon, rad; chosen: a body that rolls and pitches."""
LEAST_ROWS, LEAST_COLUMNS = 6, 24
"""Rows above the horizon that must be seen, and columns of the part that is looked for."""
LEAST_SCORE = 0.6
"""Correlation of two images; chosen: of one room or floor it is 0.8 and more, and noise has none."""
LEAST_CONTRAST = 1.5
"""Deviation of brightness from pixel to pixel, grey levels; chosen: above a camera's noise on a plain sky."""
NEAREST, FARTHEST, BESIDE, CELL = 0.4, 3.4, 1.2, 0.03
"""The floor that is compared, and its cells, lane widths; chosen: beyond, a pixel is longer than a car's way."""
LONGEST, SIDEWAYS = 0.75, 3
"""Longest way between two images, lane widths, and cells that it may go sideways."""
BRIGHTEST = 20.0
"""Change of brightness beyond which it counts no more, grey levels."""
DISTINCT = 0.97
"""Share of the best correlation that no other way may reach."""
WAY_STD = 0.03
"""Standard deviation of a way, lane widths; chosen: one cell."""
LEAST_STD = 0.004
"""Standard deviation of a turn at best, rad; chosen: a third of a pixel of 160."""


@dataclass(frozen=True, slots=True)
class Hint:
    """A motion of the car, each part with its standard deviation, infinite where nothing is known."""

    step: Array  # ahead, left, turned to the left: lane widths, lane widths, rad, (3,)
    std: Array  # (3,)

    @property
    def information(self) -> Array:
        """Inverse variances, (3,); 0 where nothing is known."""
        return np.asarray(1.0 / np.square(self.std))

    @property
    def covariance(self) -> Array:
        """(3, 3), large where nothing is known."""
        return np.diag(np.square(np.minimum(self.std, 1e3)))

    def of(self, guess: Array) -> Array:
        """A guess, (3,), with what is known put in."""
        return np.where(np.isfinite(self.std), self.step, guess)

    def fused(self, other: Hint) -> Hint:
        """Both together, each part by inverse variance."""
        information = self.information + other.information
        with np.errstate(divide="ignore", invalid="ignore"):
            step = (self.information * self.step + other.information * other.step) / information
            return Hint(np.where(information > 0.0, step, 0.0), 1.0 / np.sqrt(information))


NOTHING = Hint(np.zeros(3), np.full(3, math.inf))


class HintFinder:
    """Says from images what is known about the motion between them before single corners are followed.

    The camera is mounted, for the images' size, with lane widths as the unit of length.
    """

    def __init__(self, camera: FloorCamera) -> None:
        self._turns, self._ways = _Turns(camera), _Ways(camera)

    def see(self, image: NDArray[np.uint8]) -> Hint:
        """Motion since the last image, (rows, columns, 3) uint8 RGB; nothing for the first, or if nothing is seen."""
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
        return self._ways.see(grey, self._turns.see(grey))


class _Turns:
    """Compares what is above the horizon with the image before, moved sideways."""

    def __init__(self, camera: FloorCamera) -> None:
        self._step = 1.0 / max(camera.focal_px)
        self._most = math.ceil(LARGEST_TURN / self._step)
        pitch = camera.pitch_rad or 0.0
        edges, _ = camera.rays(np.array([[0.0, camera.horizon_row], [camera.width_px - 1.0, camera.horizon_row]]))
        depth = math.cos(pitch) - edges[:, 1] * math.sin(pitch)
        widest = WIDTH_SHARE * float(np.abs(np.arctan2(edges[:, 0], depth)).min())
        highest = min(0.6, LOWEST + camera.height_px * self._step)
        angles, heights = np.meshgrid(np.arange(widest, -widest, -self._step), np.arange(LOWEST, highest, self._step))
        ahead, right, up = np.cos(heights) * np.cos(angles), -np.cos(heights) * np.sin(angles), np.sin(heights)
        depth = np.maximum(ahead * math.cos(pitch) - up * math.sin(pitch), 1e-3)
        down = -(up * math.cos(pitch) + ahead * math.sin(pitch)) / depth
        columns, rows, in_image = camera.pixels(right / depth, down)
        inside = (
            in_image & (columns >= 0) & (columns <= camera.width_px - 1) & (rows >= 0) & (rows <= camera.height_px - 1)
        )
        whole_rows = inside.all(axis=1)
        self._map = columns[whole_rows].astype(np.float32), rows[whole_rows].astype(np.float32)
        self._usable = whole_rows.sum() >= LEAST_ROWS and angles.shape[1] >= LEAST_COLUMNS + 2 * self._most
        self._previous: NDArray[np.float32] | None = None

    def see(self, grey: NDArray[np.uint8]) -> Hint:
        """Turn since the last image, (rows, columns)."""
        if not self._usable:
            return NOTHING
        strip = self._strip(grey)
        before, self._previous = self._previous, strip
        if before is None or min(before.std(), strip.std()) < LEAST_CONTRAST:
            return NOTHING
        middle = before.shape[1] // 2
        score, turn = self._turn(before, strip)
        # What is near moves to opposite sides on the left and on the right.
        halves = np.s_[:, : middle + self._most], np.s_[:, middle - self._most :]
        left, right = (self._turn(before[half], strip[half])[1] for half in halves)
        if score < LEAST_SCORE:
            return NOTHING
        std = math.hypot(LEAST_STD, 0.5 * (left - right))
        return Hint(np.array([0.0, 0.0, turn]), np.array([math.inf, math.inf, std]))

    def _strip(self, grey: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Changes of brightness from column to column, over angles to the right and above the horizon."""
        strip = cv2.GaussianBlur(cv2.remap(grey, *self._map, cv2.INTER_LINEAR).astype(np.float32), (3, 3), 0.8)
        return np.asarray(cv2.Sobel(strip, cv2.CV_32F, 1, 0, ksize=3, scale=0.25))

    def _turn(self, before: NDArray[np.float32], after: NDArray[np.float32]) -> tuple[float, float]:
        """Best correlation of the middle of a strip with the next one, and the turn to the left, rad."""
        part = np.ascontiguousarray(before[:, self._most : before.shape[1] - self._most])
        scores = cv2.matchTemplate(np.ascontiguousarray(after), part, cv2.TM_CCOEFF_NORMED)[0].astype(float)
        best = int(scores.argmax())
        return float(scores[best]), (_peak(scores, best) - self._most) * self._step


class _Ways:
    """Compares the floor seen from above with the image before, moved ahead; the turn has to be known.

    Only changes of brightness along the way count: a line along it looks the same everywhere.
    """

    def __init__(self, camera: FloorCamera) -> None:
        self._camera = camera
        ahead = np.arange(FARTHEST, NEAREST, -CELL)
        left = np.arange(BESIDE, -BESIDE - 1e-9, -CELL)
        self._shape = len(ahead), len(left)
        self._grid = np.stack(np.meshgrid(ahead, left, indexing="ij"), axis=-1).reshape(-1, 2)
        self._unturned = self._where(0.0)
        self._previous: NDArray[np.uint8] | None = None

    def see(self, grey: NDArray[np.uint8], turn: Hint) -> Hint:
        """Turn and way since the last image, (rows, columns); the turn alone where no way is seen."""
        before, self._previous = self._previous, grey
        if before is None or not np.isfinite(turn.std[2]):
            return turn
        most = round(LONGEST / CELL)
        part = np.ascontiguousarray(_changes(before, *self._unturned)[:-most, SIDEWAYS:-SIDEWAYS])
        then = _changes(grey, *self._where(float(turn.step[2])))
        scores = cv2.matchTemplate(then, part, cv2.TM_CCORR_NORMED).max(axis=1).astype(float)
        best = int(scores.argmax())
        others = np.delete(scores, np.s_[max(best - 3, 0) : best + 4])
        if not scores[best] > LEAST_SCORE or others.max() > DISTINCT * scores[best] or not part.any():
            return turn
        return Hint(
            np.array([_peak(scores, best) * CELL, 0.0, turn.step[2]]), np.array([WAY_STD, math.inf, turn.std[2]])
        )

    def _where(self, turn: float) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Pixels of cells, (far to near, left to right), in axes turned back by `turn`, and which are well inside."""
        cos, sin = math.cos(turn), math.sin(turn)
        x, y = self._grid.T
        pixels, visible = self._camera.project(np.stack((cos * x + sin * y, cos * y - sin * x), axis=1))
        last = np.array([self._camera.width_px - 2, self._camera.height_px - 2])
        visible &= ((pixels >= 1) & (pixels <= last)).all(axis=1)
        where = np.where(visible[:, None], pixels, -10.0).astype(np.float32).reshape(*self._shape, 2)
        inside = cv2.erode(visible.reshape(self._shape).astype(np.uint8), np.ones((5, 5), np.uint8), borderValue=0)
        return where, np.asarray(inside, np.uint8)


def _changes(grey: NDArray[np.uint8], where: NDArray[np.float32], inside: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Changes of brightness along the way, of the floor seen from above."""
    warped = cv2.GaussianBlur(cv2.remap(grey, where, None, cv2.INTER_LINEAR).astype(np.float32), (5, 5), 1.2)
    change = cv2.Sobel(warped, cv2.CV_32F, 0, 1, ksize=3, scale=0.25).clip(-BRIGHTEST, BRIGHTEST)
    return np.asarray(change * inside, np.float32)


def _peak(scores: Array, best: int) -> float:
    """Place of a maximum between its neighbours."""
    if not 0 < best < len(scores) - 1:
        return float(best)
    left, peak, right = scores[best - 1 : best + 2]
    return float(best + 0.5 * (left - right) / min(left - 2.0 * peak + right, -1e-9))


CORNERS = 150
"""Corners that are followed; chosen: a picture of 160 x 120 has hardly more."""
FARTHEST_CORNER = 4.0
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
        near = valid & (floor[:, 0] < FARTHEST_CORNER) & (np.abs(floor[:, 1]) < FARTHEST_CORNER)
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
