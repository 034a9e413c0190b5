# SPDX-License-Identifier: Apache-2.0
"""How the car follows its steering: gain, trim, delay and lag of the curvature it drives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
DELAYS = np.arange(0.0, 0.41, 0.05)
LAGS = (0.0, 0.05, 0.1, 0.2)
"""Dead times and time constants that are tried, s; the camera's latency is part of the first, and may exceed it."""
LEAST_SPEED = 0.15
"""Speed below which a step says nothing about steering, lane widths/s."""
LEAST_FRAMES = 60
LEAST_SHARE = 0.2
"""Share of the curvature's variance that the steering must explain to be used; chosen: less is accident."""


@dataclass(frozen=True, kw_only=True)
class Steering:
    """Curvature of the path = gain * steering + trim, delayed and lagged."""

    gain: float  # 1/lane width, left positive, so negative for a car that steers right with positive steering
    trim: float  # 1/lane width
    delay: float  # s
    lag: float  # s
    std: float  # standard deviation of what is left, 1/lane width
    explained: float  # share of the variance that the steering explains
    curvatures: Array  # expected for the way to each frame, (n,); NaN where the steering is unknown


def follow_steering(times: Array, steering: Array, speeds: Array, yaw_rates: Array) -> Steering | None:
    """Fit gain, trim, delay and lag; None where the steering explains too little.

    Times, s, and steering, NaN where unknown, are of n frames; speeds and yaw rates, rad/s, left positive, are from one
    frame to the next.
    """
    recorded = np.isfinite(steering)
    if recorded.sum() < LEAST_FRAMES or float(np.std(steering[recorded])) < 1e-3:
        return None
    middle = 0.5 * (times[1:] + times[:-1])
    best: Steering | None = None
    for delay in DELAYS:
        for lag in LAGS:
            command = _lagged(times, np.where(recorded, steering, 0.0), middle - delay, lag)
            used = (speeds > LEAST_SPEED) & (middle - delay > times[0]) & recorded[1:] & recorded[:-1]
            if used.sum() < LEAST_FRAMES:
                continue
            rows = np.stack((command[used] * speeds[used], speeds[used]), axis=1)
            (gain, trim), *_ = np.linalg.lstsq(rows, yaw_rates[used], rcond=None)
            left = yaw_rates[used] - rows @ np.array((gain, trim))
            # Robust, as single steps may be wrong by much.
            std = float(1.4826 * np.median(np.abs(left)))
            explained = 1.0 - float(left.var()) / max(float(yaw_rates[used].var()), 1e-12)
            if best is None or explained > best.explained:
                expected = np.concatenate(([np.nan], np.where(used, gain * command + trim, np.nan)))
                best = Steering(
                    gain=float(gain),
                    trim=float(trim),
                    delay=float(delay),
                    lag=lag,
                    std=std / max(float(np.median(speeds[used])), LEAST_SPEED),
                    explained=explained,
                    curvatures=expected,
                )
    return best if best is not None and best.explained > LEAST_SHARE else None


def _lagged(times: Array, steering: Array, when: Array, lag: float) -> Array:
    """Steering, held from frame to frame, after a first-order lag, at other times."""
    at = np.clip(np.searchsorted(times, when, side="right") - 1, 0, len(times) - 1)
    if lag == 0.0:
        return np.asarray(steering[at])
    state = np.empty_like(steering)
    state[0] = steering[0]
    for index, share in enumerate(1.0 - np.exp(-np.diff(times) / lag)):
        state[index + 1] = state[index] + share * (steering[index] - state[index])
    share = 1.0 - np.exp(-np.maximum(when - times[at], 0.0) / lag)
    return np.asarray(state[at] + share * (steering[at] - state[at]))
