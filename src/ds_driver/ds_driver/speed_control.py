"""Throttle from a wanted speed, for drivers that think in metres per second."""

from __future__ import annotations

PROPORTIONAL = 0.5
"""Throttle per m/s of error; chosen: full throttle 2 m/s below the wanted speed."""
INTEGRAL = 0.02
"""Throttle per m/s of error and frame; chosen: the throttle that holds a speed is found within two seconds on the
weakest vehicle here, the twin, without overshoot above 0.5 m/s on the strongest."""


class SpeedControl:
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
