# SPDX-License-Identifier: Apache-2.0
"""Control laws of the paper (section 3.2.1): steering of the autopilot, and throttle of all drivers."""

from __future__ import annotations

from ds_sim.simulator import AutopilotGains, Command

START_THROTTLE = 0.5
"""Throttle for starting with the wheels at full lock, where equation 2 gives none (maxitwo)."""
_STANDSTILL = 0.1
"""Speed below which a vehicle counts as standing, m/s."""


def throttle(steering: float, speed: float, *, max_speed: float = 30.0, min_speed: float = 15.0) -> float:
    """Throttle in [0, 1] by the paper's equation 2, for steering in [-1, 1] at a speed in m/s.

    K is H, `max_speed` in km/h (paper 4.2.4: 30), up to that speed, and L, `min_speed` (maxitwo: 15), above it.
    """
    kmh = speed * 3.6
    k = min_speed if kmh > max_speed else max_speed
    value = 1.0 - steering**2 - (kmh / k) ** 2
    if abs(steering) >= 1.0 and speed < _STANDSTILL:
        value = START_THROTTLE
    return min(max(value, 0.0), 1.0)


ROWS_SEEN = (0, 1)
"""First row and end of the image rows that it looks at: none, so as few as a simulator can draw."""


class Autopilot:
    """Autopilot by the paper's equation 1: a PID controller on the lateral position, for one run.

    The position is that of a preview point ahead of the vehicle (`preview_lateral_position`); the authors' simulators
    also send the autopilot a separate error (`cte_pid`).

    Examples:
        >>> from ds_driver import Autopilot
        >>> from ds_sim import spec_of
        >>> autopilot = Autopilot(spec_of("bullet").autopilot)
        >>> command = autopilot.command(lateral_position=0.5, speed=5.0)  # too far to the right
        >>> command.steering < 0.0
        True
    """

    def __init__(self, gains: AutopilotGains) -> None:
        self._gains = gains
        self._previous: float | None = None
        self._total = 0.0

    def command(self, lateral_position: float, speed: float) -> Command:
        """Steer back to the centre of the lane from a lateral position, m, right positive, at a speed, m/s."""
        gains = self._gains
        previous = lateral_position if self._previous is None else self._previous
        self._previous = lateral_position
        self._total += lateral_position
        steering = -(
            gains.proportional * lateral_position
            + gains.derivative * (lateral_position - previous)
            + gains.integral * self._total
        )
        steering = min(max(steering, -1.0), 1.0)
        return Command(steering, throttle(steering, speed, max_speed=gains.max_speed, min_speed=gains.min_speed))
