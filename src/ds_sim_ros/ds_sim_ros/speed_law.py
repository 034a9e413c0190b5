# SPDX-License-Identifier: Apache-2.0
"""The law by which a throttle becomes the speed that a message asks for."""

from __future__ import annotations

from ds_sim.simulator import FRAME_TIME


class SpeedLaw:
    """Speed of a car that the throttle accelerates and a drag slows down: u' = acceleration * throttle - drag * u.

    It does not look at the vehicle, so that what is asked for depends on the commands alone. A speed that were
    proportional to the throttle would make equation 2 swing, as a simulator may follow within one frame.

    Args:
        acceleration: at full throttle, m/s^2.
        drag: 1/s.
    """

    def __init__(self, acceleration: float, drag: float) -> None:
        self._acceleration, self._drag = acceleration, drag
        self.speed = 0.0

    def reset(self) -> None:
        """Begin at rest."""
        self.speed = 0.0

    def advance(self, throttle: float) -> float:
        """Advance by one frame with a throttle from 0 to 1; returns the speed at its end, m/s."""
        # Implicit in the drag, so that no permitted value of it makes the speed swing.
        gained = self.speed + self._acceleration * throttle * FRAME_TIME
        self.speed = gained / (1.0 + self._drag * FRAME_TIME)
        return self.speed
