"""Throttle from a wanted speed, for drivers that think in metres per second."""

from __future__ import annotations

PROPORTIONAL = 0.3
"""Throttle per m/s of error; chosen by trial on the three vehicles."""
INTEGRAL = 0.005
"""Throttle per m/s of error and frame; chosen by trial: at 3 and 6 m/s each of the three vehicles is within 0.3 m/s
after six seconds, and passes the speed by 0.5 m/s at most on the way."""


class SpeedController:
    """A PI controller on the speed, once per frame; its integral stands while the throttle is at a limit."""

    def __init__(self) -> None:
        self._integral = 0.0

    def reset(self) -> None:
        """A new run begins."""
        self._integral = 0.0

    def throttle(self, wanted: float, speed: float) -> float:
        """Throttle in [0, 1]; 0 to stop: the vehicles coast, they have no brake.

        Args:
            wanted: m/s.
            speed: m/s.
        """
        if wanted <= 0.0:
            self._integral = 0.0
            return 0.0
        error = wanted - speed
        asked = PROPORTIONAL * error + self._integral + INTEGRAL * error
        throttle = min(max(asked, 0.0), 1.0)
        if throttle == asked or (asked > 1.0) != (error > 0.0):
            self._integral = min(max(self._integral + INTEGRAL * error, 0.0), 1.0)
        return throttle
