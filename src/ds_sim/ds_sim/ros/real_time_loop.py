# SPDX-License-Identifier: Apache-2.0
"""Drives frames at an even rate, 20 a second, and measures how late they come."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from rclpy.clock import Clock
from rclpy.node import Node

from ds_sim.simulator import FRAME_TIME, Command


class FrameJitter:
    """Statistics of beats that should come at an even period from a start on, s of any steady clock."""

    def __init__(self, period: float, start: float) -> None:
        self._period = period
        self._start = start
        self._late: list[float] = []
        self._last = 0
        self.missed = 0
        """Number of grid points without a frame, because the previous frame took too long."""

    def beat(self, now: float) -> None:
        """Note a beat, at a time of the same clock; it belongs to the last point of the grid that has passed."""
        elapsed = max(0.0, now - self._start)
        index = int(elapsed / self._period)
        self._late.append(elapsed - index * self._period)
        self.missed += max(0, index - self._last - 1)
        self._last = index

    def lateness(self, quantile: float) -> float:
        """Return a quantile in [0, 1] of the frames' delays after their grid points, s; 0 without frames."""
        return float(np.quantile(self._late, quantile)) if self._late else 0.0

    def __str__(self) -> str:
        """Summarise the jitter in one line."""
        median, most, worst = (1e3 * self.lateness(q) for q in (0.5, 0.99, 1.0))
        return (
            f"real time: {len(self._late)} frames at {1.0 / self._period:g} Hz, late by {median:.1f} ms in the median, "
            f"{most:.1f} ms at 99%, {worst:.1f} ms at worst; {self.missed} frames missed"
        )


class RealTimeLoop:
    """Calls `advance` 20 times a second of a steady clock with the last command."""

    def __init__(self, node: Node, clock: Clock, advance: Callable[[Command], None]) -> None:
        self._clock = clock
        self._advance = advance
        self._held: Command | None = None
        self._jitter: FrameJitter | None = None
        self._timer = node.create_timer(FRAME_TIME, self._tick, clock=clock)
        self._timer.cancel()

    def hold(self, command: Command) -> None:
        """Hold a command from now on; the first one starts the loop, as its driver may have to start first."""
        self._held = command
        if self._jitter is None:
            self._jitter = FrameJitter(FRAME_TIME, self._now())
            self._timer.reset()

    def end(self) -> str:
        """Stop, and return one line on how well time was kept; "" if the loop never ran."""
        summary = "" if self._jitter is None else str(self._jitter)
        self._held = self._jitter = None
        self._timer.cancel()
        return summary

    def _now(self) -> float:
        return float(self._clock.now().nanoseconds) * 1e-9

    def _tick(self) -> None:
        if self._held is not None and self._jitter is not None:
            self._jitter.beat(self._now())
            self._advance(self._held)
