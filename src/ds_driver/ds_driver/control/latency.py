"""Statistics of the time that a driver takes from an image to its command. No ROS."""

from __future__ import annotations

from collections import deque

import numpy as np

WINDOW = 200
"""Number of frames in the statistics; chosen: ten seconds at 20 Hz."""


class Latency:
    """Collects the latencies of the last frames."""

    def __init__(self) -> None:
        self._seconds: deque[float] = deque(maxlen=WINDOW)
        self.answered = 0
        """Total number of frames answered."""
        self.refused = 0
        """Total number of frames that could not be answered."""

    def add(self, seconds: float) -> None:
        """Record that a frame was answered after a time in s."""
        self._seconds.append(seconds)
        self.answered += 1

    def values(self) -> dict[str, str]:
        """Values for the diagnostics, by name; times in ms over the last `WINDOW` frames."""
        values = {"frames answered": str(self.answered), "frames refused": str(self.refused)}
        if self._seconds:
            times = 1e3 * np.array(self._seconds)
            values["latency mean ms"] = f"{times.mean():.3f}"
            values["latency p95 ms"] = f"{np.quantile(times, 0.95):.3f}"
            values["latency max ms"] = f"{times.max():.3f}"
        return values
