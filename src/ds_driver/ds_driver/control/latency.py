"""How long a driver takes from an image to its command. No ROS."""

from __future__ import annotations

from collections import deque

import numpy as np

WINDOW = 200
"""Frames that are summed up: ten seconds at 20 Hz; chosen."""


class Latency:
    """Collects the times of the last frames."""

    def __init__(self) -> None:
        self._seconds: deque[float] = deque(maxlen=WINDOW)
        self.answered = 0
        """Frames answered in all."""
        self.refused = 0
        """Frames that could not be answered in all."""

    def add(self, seconds: float) -> None:
        """A frame was answered after so many seconds."""
        self._seconds.append(seconds)
        self.answered += 1

    def values(self) -> dict[str, str]:
        """What is told, by name; times of the last `WINDOW` frames in ms."""
        values = {"frames answered": str(self.answered), "frames refused": str(self.refused)}
        if self._seconds:
            times = 1e3 * np.array(self._seconds)
            values["latency mean ms"] = f"{times.mean():.3f}"
            values["latency p95 ms"] = f"{np.quantile(times, 0.95):.3f}"
            values["latency max ms"] = f"{times.max():.3f}"
        return values
