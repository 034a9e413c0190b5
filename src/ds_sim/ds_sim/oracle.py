"""Test oracle: judges every frame of a run and decides when and how the run ends (paper 3.1.3, 3.3)."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from ds_sim.simulator import FRAME_RATE, Outcome


@dataclass(frozen=True, kw_only=True)
class OracleLimits:
    """Thresholds that end a run.

    Attributes:
        finish_margin: distance before the end of the lane at which the road counts as completed, m; chosen: about half
            a car, so that the front bumper reaches the last road point (maxitwo stops 8 m short of it).
        stuck_distance: a vehicle that covers less than this within `stuck_time` is stuck, m (maxitwo's detector, SBFT
            competition: 1 m).
        stuck_time: simulated time, s (the same detector: 10 s).
        max_steps: number of steps after which the run times out (maxitwo: 2000 steps).
    """

    finish_margin: float = 2.0
    stuck_distance: float = 1.0
    stuck_time: float = 10.0
    max_steps: int = 2000


class Oracle:
    """Judges one run.

    Args:
        lane_length: length of the lane's centre line, m.
        limits: thresholds that end the run.
    """

    def __init__(self, lane_length: float, limits: OracleLimits | None = None) -> None:
        self._limits = limits or OracleLimits()
        self._finish = lane_length - self._limits.finish_margin
        self._progress: deque[float] = deque(maxlen=round(self._limits.stuck_time * FRAME_RATE) + 1)

    def judge(self, *, step: int, lateral_distance: float, arc_length: float) -> Outcome:
        """Judge one frame; out of bounds takes precedence over anything else in the same frame.

        Args:
            step: steps since the start of the run.
            lateral_distance: half a lane minus |lateral position|, m.
            arc_length: distance along the lane's centre line, m.
        """
        self._progress.append(arc_length)
        if lateral_distance < 0.0:
            return Outcome.OUT_OF_BOUNDS
        if arc_length >= self._finish:
            return Outcome.COMPLETED
        full = len(self._progress) == self._progress.maxlen
        if full and max(self._progress) - min(self._progress) < self._limits.stuck_distance:
            return Outcome.STUCK
        if step >= self._limits.max_steps:
            return Outcome.TIMEOUT
        return Outcome.RUNNING
