"""Controls the throttle to reach a desired speed, for drivers that command speeds."""

from __future__ import annotations

PROPORTIONAL = 0.3
"""Proportional gain, throttle per m/s of error; chosen by trial on the three vehicles."""
INTEGRAL = 0.005
"""Integral gain, throttle per m/s of error and frame; chosen by trial: at 3 and 6 m/s each of the three vehicles is
within 0.3 m/s after six seconds, with an overshoot of 0.5 m/s at most."""


class SpeedController:
    """PI controller on the speed with anti-windup, updated once per frame."""

    def __init__(self) -> None:
        self._integral = 0.0

    def reset(self) -> None:
        """Reset the integral at the start of a run."""
        self._integral = 0.0

    def throttle(self, desired: float, speed: float) -> float:
        """Throttle in [0, 1]; 0 to stop, because the vehicles have no brake and coast.

        Args:
            desired: desired speed, m/s.
            speed: current speed, m/s.
        """
        if desired <= 0.0:
            self._integral = 0.0
            return 0.0
        error = desired - speed
        unclipped = PROPORTIONAL * error + self._integral + INTEGRAL * error
        throttle = min(max(unclipped, 0.0), 1.0)
        if throttle == unclipped or (unclipped > 1.0) != (error > 0.0):
            self._integral = min(max(self._integral + INTEGRAL * error, 0.0), 1.0)
        return throttle
