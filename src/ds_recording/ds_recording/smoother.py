# SPDX-License-Identifier: Apache-2.0
"""Poses of the whole run and the road's centre line together, by robust least squares (a smoother).

Unknown are x, y and yaw of the car in every frame, and how far the centre line lies beside its last guess at every
point. What speaks about them: points of painted lines, motions between images, limits of how fast a car's speed and yaw
rate and a road's curvature change, and the steering. Frames without lines are carried by the rest, with their variance.

Gauss-Newton on a sparse matrix, as `scipy.optimize.least_squares` only has LSMR for those, which needs thousands of
steps along a chain of frames; a factorisation needs one. Lengths are in lane widths.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csc_matrix
from scipy.sparse.linalg import splu

from ds_base.progress import SILENT, Progress
from ds_recording.first_guess import SPACING
from ds_recording.lines import LinePoints
from ds_recording.motion import Hint, Motion
from ds_recording.steering import Steering, follow_steering
from ds_recording.track import Track, wrap

Array = NDArray[np.float64]
Index = NDArray[np.int64]
GATE = 2.5
"""Residual of a line's point beyond which it counts for little, standard deviations."""
FLOOR = 0.02
"""Standard deviation of a line's point beyond that of its pixel, lane widths; chosen: a tape's edges, a body's roll."""
TOGETHER = 2.0
"""Factor on it, as neighbouring points share their errors; chosen on simulated recordings."""
MOTION_FACTOR, MOTION_FLOOR = 1.5, (0.002, 0.002, 0.0015)
"""Factor on the standard deviations of motions, and what is added to them: lane widths, lane widths, rad."""
ACCELERATION = (2.0, 0.5, 4.0)
"""Deviation of changes of speed ahead, left (lane widths/s^2), of yaw rate (rad/s^2); chosen: a second to speed."""
CLOCK = 0.08
"""Error of the time between two frames, as a share; chosen: 3 ms of 50 ms on either side."""
BEND = 0.05
"""Deviation of the curvature's change along one piece, 1/lane width; chosen: radius 2.5 within two lane widths."""
LONGER = 1.5
"""Factor by which a line may grow before the search counts as lost."""
_TRIES = 5
"""Shorter and shorter steps that are tried."""
NEAR = 1.5
"""Distance of the line's points that are used first, lane widths."""
TURNS = 16
"""Gauss-Newton steps; chosen: the last ones move nothing by more than a thousandth."""


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """What one stretch of a recording says."""

    times: Array  # s, (n,), increasing
    lines: list[LinePoints]
    motions: list[Motion | None]  # of each frame, from the one before, hints included; None where it was not seen
    hints: list[Hint]  # about each frame's motion
    steering: Array  # of each frame, -1 left to +1 right; NaN where unknown, (n,)


@dataclass(frozen=True, kw_only=True)
class Solution:
    """Poses and road."""

    poses: Array  # x, y, yaw, (n, 3)
    track: Track
    along: Array  # station of each pose, (n,)
    lateral: Array  # offset to the right of the centre line, (n,)
    heading: Array  # relative to the line's, left positive, (n,)
    std_lateral: Array
    std_heading: Array
    agree: Array  # share of each frame's line points that are where the road has its lines, NaN without points, (n,)
    residuals: Array  # median distance of these points from their line, (n,)
    steering: Steering | None  # gain and delay; None if unknown


@dataclass
class _Rows:
    """Rows of the least-squares problem, weighted, as they are collected."""

    rows: list[Index] = field(default_factory=list)
    columns: list[Index] = field(default_factory=list)
    values: list[Array] = field(default_factory=list)
    right: list[Array] = field(default_factory=list)
    count: int = 0

    def add(self, columns: list[Index], slopes: list[Array], residuals: Array, weights: Array) -> None:
        """Add one row for each residual: weight * (residual + slopes * change of columns) is to vanish."""
        here = self.count + np.arange(len(residuals))
        for column, slope in zip(columns, slopes, strict=True):
            self.rows.append(here)
            self.columns.append(np.broadcast_to(column, here.shape))
            self.values.append(np.broadcast_to(slope, here.shape) * weights)
        self.right.append(-residuals * weights)
        self.count += len(residuals)

    @property
    def cost(self) -> float:
        """Sum of squares."""
        return float(sum((part**2).sum() for part in self.right))

    def solve(self, unknowns: int, damping: Array, step_damping: float = 0.0) -> tuple[Array, Callable[[Array], Array]]:
        """Changes of the unknowns, shortened by `step_damping`, and what multiplies by their covariance matrix."""
        entries = (np.concatenate(self.rows), np.concatenate(self.columns))
        matrix = coo_matrix((np.concatenate(self.values), entries), shape=(self.count, unknowns)).tocsc()
        normal = csc_matrix(matrix.T @ matrix)
        normal.setdiag(normal.diagonal() * (1.0 + step_damping) + damping)
        factors = splu(normal, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}, diag_pivot_thresh=0.0)
        return factors.solve(matrix.T @ np.concatenate(self.right)), factors.solve


class Smoother:
    """Solves one stretch, from a first guess of poses, (n, 3), and track.

    `stations` is a first guess of the piece of the track at each pose, (n,); they are found along the line if omitted.
    """

    def __init__(self, evidence: Evidence, poses: Array, track: Track, stations: Index | None = None) -> None:
        self._evidence, self._poses, self._track = evidence, poses.copy(), track
        self._frames = np.repeat(np.arange(len(poses)), [len(points) for points in evidence.lines])
        self._points = np.concatenate([points.floor for points in evidence.lines])
        self._white = np.concatenate([points.white for points in evidence.lines])
        self._spread = np.concatenate([points.spread for points in evidence.lines])
        self._pieces = self._walk() if stations is None else stations
        self._nearest = self._pieces[self._frames] + (self._points[:, 0] / SPACING).astype(np.int64)
        self._far, self._longest = np.inf, track.length + 10.0
        self._steering: Steering | None = None
        self._seconds = np.diff(evidence.times)
        pairs = list(zip(evidence.motions, evidence.hints, strict=True))
        with_motion = [i for i, (motion, hint) in enumerate(pairs) if i and (motion or np.isfinite(hint.std).any())]
        self._seen = np.array(with_motion, dtype=np.int64)
        measured = [
            (motion.step, motion.covariance) if motion else (hint.step, hint.covariance) for motion, hint in pairs
        ]
        self._steps = np.array([measured[i][0] for i in with_motion]).reshape(-1, 3)
        spread = np.array([measured[i][1] for i in with_motion]).reshape(-1, 3, 3) * MOTION_FACTOR**2
        spread = spread + np.diag(np.square(MOTION_FLOOR))
        self._whitening = np.linalg.inv(np.linalg.cholesky(spread))

    def solve(self, turns: int = TURNS, progress: Progress = SILENT) -> Solution:
        """Run Gauss-Newton, with the gates closing, and return what was found."""
        step_damping = 1e-5
        for turn in range(turns):
            # From near to far: what is far away turns a road that is only guessed by too much.
            self._far = NEAR + 1.0 * turn
            gate = max(1.0, 6.0 * 0.6**turn)
            rows = self._rows(gate)
            now = rows.cost
            for _ in range(_TRIES):
                state = self._poses.copy(), self._track, self._pieces, self._nearest
                change, _ = rows.solve(self._unknowns, self._damping, step_damping)
                self._apply(change)
                if self._sound and self._rows(gate).cost < 1.2 * now:
                    step_damping *= 0.2
                    break
                # The step went astray: a shorter one, after Marquardt.
                self._poses, self._track, self._pieces, self._nearest = state
                step_damping = max(10.0 * step_damping, 1e-4)
            if turn in (4, 8):
                self._steering = self._follow()
            progress.advance(line="steps of the solution for the whole run")
        progress.describe("how sure it is, image by image")
        return self._solution()

    @property
    def _count(self) -> int:
        return len(self._poses)

    @property
    def _unknowns(self) -> int:
        return 3 * self._count + len(self._track.points)

    @property
    def _damping(self) -> Array:
        # Fixes the frame of reference, and what nothing speaks about.
        damping = np.full(self._unknowns, 1e-4)
        damping[:3] += 1e6
        return damping

    def _walk(self) -> Index:
        """Piece of the track beside each pose, one after the other."""
        start = self._track.points[: round(4.0 / SPACING)]  # the line passes here again, a lap later
        index = np.array([int(np.argmin(np.hypot(*(start - self._poses[0, :2]).T)))])
        pieces = []
        for pose in self._poses:
            index = self._track.nearest(pose[None, :2], index)
            pieces.append(int(index[0]))
        return np.array(pieces, dtype=np.int64)

    def _rows(self, gate: float) -> _Rows:
        rows = _Rows()
        self._add_lines(rows, gate)
        self._add_motions(rows, gate)
        self._add_inertia(rows)
        self._add_bends(rows)
        if self._steering is not None:
            self._add_steering(rows, self._steering)
        return rows

    def _line_errors(self) -> tuple[Array, Array, Array, Index]:
        """Errors of all points of lines, their standard deviations, the road's left at each, and their pieces."""
        track, pose = self._track, self._poses[self._frames]
        cos, sin = np.cos(pose[:, 2]), np.sin(pose[:, 2])
        turned = np.stack(
            (cos * self._points[:, 0] - sin * self._points[:, 1], sin * self._points[:, 0] + cos * self._points[:, 1]),
            1,
        )
        places = turned + pose[:, :2]
        self._nearest = track.nearest(places, self._nearest)
        _, offset, heading = track.place(places, self._nearest)
        left = np.stack((-np.sin(heading), np.cos(heading)), axis=1)
        target = np.where(self._white, np.where(offset < 0.0, 1.0, -1.0), 0.0)
        own = np.stack((left[:, 0] * cos + left[:, 1] * sin, left[:, 1] * cos - left[:, 0] * sin), axis=1)
        spread = np.hypot(*np.einsum("ni,nij->jn", own, self._spread))
        self._turned = turned
        return -offset - target, TOGETHER * np.hypot(spread, FLOOR), left, self._nearest

    def _add_lines(self, rows: _Rows, gate: float) -> None:
        error, std, left, piece = self._line_errors()
        size = error / std / (GATE * gate)
        weights = (self._points[:, 0] < self._far) / (1.0 + size**2) / std  # root of Geman-McClure's weight
        share = (self._turned + self._poses[self._frames, :2] - self._track.points[piece]) * self._track.tangents[piece]
        share = share.sum(axis=1) / self._track.lengths[piece]
        weights *= (share > -0.5) & (share < 1.5)  # not beyond the ends of the line
        share = share.clip(0.0, 1.0)
        turning = left[:, 1] * self._turned[:, 0] - left[:, 0] * self._turned[:, 1]
        base, knots = 3 * self._frames, 3 * self._count + np.stack((piece, self._next(piece)))
        rows.add(
            [base, base + 1, base + 2, knots[0], knots[1]],
            [left[:, 0], left[:, 1], turning, share - 1.0, -share],
            error,
            weights,
        )

    def _next(self, index: Index) -> Index:
        return (index + 1) % len(self._track.points)

    def _body_steps(self) -> tuple[Array, Array, Array]:
        """Motion from each frame to the next in the axes of the first, (n - 1, 3), and cosines and sines of its yaw."""
        step = np.diff(self._poses, axis=0)
        cos, sin = np.cos(self._poses[:-1, 2]), np.sin(self._poses[:-1, 2])
        ahead, left = cos * step[:, 0] + sin * step[:, 1], cos * step[:, 1] - sin * step[:, 0]
        return np.stack((ahead, left, step[:, 2]), axis=1), cos, sin

    def _step_slopes(self, chosen: Index) -> tuple[list[Index], Array]:
        """Columns and slopes, (6, n, 3), of body steps that start at the chosen frames."""
        step, cos, sin = (values[chosen] for values in self._body_steps())
        zero, one = np.zeros_like(cos), np.ones_like(cos)
        base = 3 * chosen
        slopes = [
            (-cos, sin, zero),
            (-sin, -cos, zero),
            (step[:, 1], -step[:, 0], -one),
            (cos, -sin, zero),
            (sin, cos, zero),
            (zero, zero, one),
        ]
        return [base + i for i in range(6)], np.stack([np.stack(s, axis=1) for s in slopes])

    def _add_motions(self, rows: _Rows, gate: float) -> None:
        if not len(self._seen):
            return
        before = self._seen - 1
        columns, slopes = self._step_slopes(before)
        error = np.einsum("nij,nj->ni", self._whitening, self._body_steps()[0][before] - self._steps)
        slopes = np.einsum("nij,knj->kni", self._whitening, slopes)
        weights = 1.0 / (1.0 + (error**2).sum(axis=1) / (4.0 * gate) ** 2)
        for part in range(3):
            rows.add(columns, list(slopes[:, :, part]), error[:, part], weights)

    def _add_inertia(self, rows: _Rows) -> None:
        """Speeds change slowly: differences of neighbouring steps over their times."""
        step, dt = self._body_steps()[0], self._seconds
        speed = step / dt[:, None]
        first = np.arange(self._count - 2)
        columns_a, slopes_a = self._step_slopes(first)
        columns_b, slopes_b = self._step_slopes(first + 1)
        between = 0.5 * (dt[1:] + dt[:-1])
        for part in range(3):
            noise = CLOCK * np.abs(0.5 * (speed[1:, part] + speed[:-1, part])) * min(1.0, 0.05 / float(np.median(dt)))
            std = np.hypot(ACCELERATION[part] * between, noise)
            rows.add(
                [*columns_a, *columns_b],
                [*(-slopes_a[:, :, part] / dt[:-1]), *(slopes_b[:, :, part] / dt[1:])],
                speed[1:, part] - speed[:-1, part],
                1.0 / std,
            )

    def _add_bends(self, rows: _Rows) -> None:
        """The curvature of the road changes slowly along it."""
        track, count = self._track, len(self._track.points)
        curvature, spacing = track.curvature, float(track.lengths.mean())
        first = np.arange(count if track.closed else count - 3)
        knots = [3 * self._count + (first + i) % count for i in range(4)]
        start = (first + 1) % count
        change = curvature[(start + 1) % count] - curvature[start]
        inverse = 1.0 / spacing**2
        slopes = [np.full(len(first), s * inverse) for s in (-1.0, 3.0, -3.0, 1.0)]
        rows.add(knots, slopes, change, np.full(len(first), 1.0 / BEND))

    def _add_steering(self, rows: _Rows, steering: Steering) -> None:
        """Yaw follows the steering times the way: a weak word, as a tyre slips and a servo has play."""
        step = self._body_steps()[0]
        chosen = np.flatnonzero(np.isfinite(steering.curvatures[1:]))
        if not len(chosen):
            return
        bend = steering.curvatures[chosen + 1]
        columns, slopes = self._step_slopes(chosen)
        error = step[chosen, 2] - bend * step[chosen, 0]
        std = np.maximum(steering.std * np.maximum(np.abs(step[chosen, 0]), 0.02), 0.002) * 2.0
        rows.add(columns, list(slopes[:, :, 2] - bend * slopes[:, :, 0]), error, 1.0 / std)

    def _follow(self) -> Steering | None:
        step, dt = self._body_steps()[0], self._seconds
        return follow_steering(self._evidence.times, self._evidence.steering, step[:, 0] / dt, step[:, 2] / dt)

    @property
    def _sound(self) -> bool:
        return bool(np.isfinite(self._track.points).all() and self._track.length < LONGER * self._longest)

    def _apply(self, change: Array) -> None:
        count = self._count
        self._poses += change[: 3 * count].reshape(-1, 3)
        self._track = self._track.beside(-change[3 * count :])
        # Even steps again: what was beside a bend has been stretched or squeezed.
        if not self._sound:
            return
        ratio = self._track.stations / self._track.length
        self._track = self._track.resampled(SPACING)
        shares = [ratio[self._pieces], ratio[self._nearest]]
        self._pieces, self._nearest = ((share * self._track.pieces).astype(np.int64) for share in shares)
        self._pieces = self._track.nearest(self._poses[:, :2], self._pieces)

    def _solution(self) -> Solution:
        rows = self._rows(1.0)
        _, multiply = rows.solve(self._unknowns, self._damping)
        track, poses = self._track, self._poses
        along, lateral, heading = track.place(poses[:, :2], self._pieces)
        std_lateral, std_heading = self._deviations(multiply, heading)
        error, std, _, _ = self._line_errors()
        good = np.abs(error) < GATE * std
        counts = np.bincount(self._frames, minlength=self._count)
        with np.errstate(invalid="ignore"):
            agree = np.bincount(self._frames, good, self._count) / np.where(counts, counts, np.nan)
        residuals = np.full(self._count, np.nan)
        for frame in np.flatnonzero(counts):
            first = int(np.searchsorted(self._frames, frame))
            residuals[frame] = np.median(np.abs(error[first : first + counts[frame]]))
        return Solution(
            poses=poses.copy(),
            track=track,
            along=along,
            lateral=lateral,
            heading=wrap(poses[:, 2] - heading),
            std_lateral=std_lateral,
            std_heading=std_heading,
            agree=agree,
            residuals=residuals,
            steering=self._follow(),
        )

    def _deviations(self, multiply: Callable[[Array], Array], heading: Array) -> tuple[Array, Array]:
        """Standard deviations of offset and relative heading, from columns of the covariance matrix."""
        count, knots = self._count, 3 * self._count
        length = self._track.lengths[self._pieces]
        deviations = [np.zeros(count), np.zeros(count)]
        for first in range(0, count, 256):
            frames = np.arange(first, min(first + 256, count))
            here = np.arange(len(frames))
            piece = self._pieces[frames]
            for kind in range(2):
                wanted = np.zeros((self._unknowns, len(frames)))
                if kind == 0:
                    wanted[3 * frames, here] = -np.sin(heading[frames])
                    wanted[3 * frames + 1, here] = np.cos(heading[frames])
                    wanted[knots + piece, here] -= 0.5
                    wanted[knots + self._next(piece), here] -= 0.5
                else:
                    wanted[3 * frames + 2, here] = 1.0
                    wanted[knots + piece, here] += 1.0 / length[frames]
                    wanted[knots + self._next(piece), here] -= 1.0 / length[frames]
                deviations[kind][frames] = np.sqrt(np.maximum((wanted * multiply(wanted)).sum(axis=0), 0.0))
        return deviations[0], deviations[1]
