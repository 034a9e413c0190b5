# SPDX-License-Identifier: Apache-2.0
"""Changes commands on their way from driver to vehicle: dead time, lag, pull to one side, speed limit."""

from __future__ import annotations

import math
from collections import deque

from ds_sim.conditions.model import Conditions
from ds_sim.simulator import FRAME_TIME, Command

COMMAND_CONDITIONS = frozenset({"steering_lag", "command_delay", "tyre_pull", "speed_limit"})
"""Conditions that act on commands alone, so that every vehicle has them."""
LIMITER_BAND = 0.1
"""Speed range below the limit over which the throttle is reduced to zero, over the limit; chosen: a tenth, as the
limiters of the simulated cars have it above theirs."""


class Actuation:
    """What becomes of the commands of one run.

    Args:
        conditions: of the run.
        max_steering_angle: angle of the wheels for |steering| = 1, rad.
    """

    def __init__(self, conditions: Conditions, max_steering_angle: float) -> None:
        self._lag = conditions.steering_lag
        self._offset = -conditions.tyre_pull / max_steering_angle  # steering is right positive
        self._limit = conditions.speed_limit
        frames, self._rest = divmod(round(conditions.command_delay / FRAME_TIME, 6), 1.0)
        self._sent: deque[Command] = deque([Command(0.0, 0.0)] * (int(frames) + 2), maxlen=int(frames) + 2)
        self._steering = 0.0

    def reached(self, command: Command, speed: float) -> Command:
        """Command that the vehicle executes during this step, at its speed at the start of it, m/s."""
        self._sent.append(command)
        older, newer = self._sent[0], self._sent[1]
        # A dead time of part of a frame: the mean of what is held before and after the change.
        steering = newer.steering + self._rest * (older.steering - newer.steering)
        throttle = newer.throttle + self._rest * (older.throttle - newer.throttle)
        if self._lag > 0.0:
            # Held over the step is the value that the lagging steering has in its middle.
            towards = steering
            steering = towards + (self._steering - towards) * math.exp(-0.5 * FRAME_TIME / self._lag)
            self._steering = towards + (self._steering - towards) * math.exp(-FRAME_TIME / self._lag)
        if self._limit is not None:
            throttle *= min(max((self._limit - speed) / (LIMITER_BAND * self._limit), 0.0), 1.0)
        return Command(min(max(steering + self._offset, -1.0), 1.0), throttle)
