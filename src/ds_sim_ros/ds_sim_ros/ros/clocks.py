# SPDX-License-Identifier: Apache-2.0
"""Advances another simulator by one frame of 1/20 s, in lock-step or in real time.

Both go by the stamps of the messages. Arrival would not do: an image may arrive before the answer of the step that it
was taken after, and a simulator may publish several messages a frame.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from ds_sim.simulator import FRAME_TIME, SimulatorError
from ds_sim_ros.ros.topics_and_services import Pair, Received, Services, Topics
from ds_sim_ros.settings import StepSettings

FRAME = round(FRAME_TIME * 1e9)
"""Time of a frame, ns."""
QUIET = 0.1
"""Time without a message after which a simulator that stands still has sent all, s; chosen: a hundred times the way of
a message on one machine."""
AtStart = Callable[[Any], bool]
"""Whether an odometry is that of the vehicle at the start."""


class LockStep:
    """Asks for the steps of each frame, and waits for the messages that are stamped with its end."""

    latency = None

    def __init__(self, topics: Topics, services: Services, settings: StepSettings) -> None:
        self._topics, self._services, self._settings = topics, services, settings
        self._now = 0
        self._tolerance = round(settings.seconds * 0.5e9)

    def connect(self) -> None:
        """Step until both topics have been heard, as the first messages to a new subscription may be lost."""
        deadline = self._topics.deadline
        while self._topics.newest() is None:
            if time.monotonic() > deadline:
                raise self._topics.missing("after a step")
            self._step(repeatable=True)
            time.sleep(QUIET)

    def begin(self, at_start: AtStart) -> Pair:
        """Pass one frame at rest, as a simulator that is reset may publish nothing before it.

        Returns what shows the vehicle at the start, or the newest messages if it does not get there in time.
        """
        time.sleep(QUIET)  # what was sent before the reset arrives, and is forgotten
        self._topics.clear()
        self._step()

        def is_settled(odometry: Received, image: Received) -> bool:
            quiet = time.monotonic() - max(odometry.arrived, image.arrived) >= QUIET
            return quiet and abs(odometry.stamp - image.stamp) <= self._tolerance and at_start(odometry.message)

        newest = self._topics.settled(is_settled, QUIET / 4, "a step")
        self._now = newest[0].stamp
        return newest

    def advance(self) -> Pair:
        """Pass one frame with the command that was sent; returns the odometry and the image of its end."""
        self._step()
        self._now += FRAME
        earliest = self._now - self._tolerance
        odometry, image = self._topics.wait(earliest, earliest)
        ahead = max(odometry.stamp, image.stamp) - self._now
        if ahead > self._tolerance:
            raise SimulatorError(
                f"after steps of {FRAME_TIME:g} s a message is stamped {ahead / 1e9:.3f} s later than expected: pause "
                "the simulator, or correct time.seconds"
            )
        return odometry, image

    def _step(self, *, repeatable: bool = False) -> None:
        request = {"simulation_interfaces/srv/StepSimulation": {"steps": self._settings.per_frame}}
        self._services.call(self._settings.step, request, repeatable=repeatable)


class RealTime:
    """Lets time pass; a frame ends with the first odometry 1/20 s after the frame before, by its stamp."""

    def __init__(self, topics: Topics) -> None:
        self._topics = topics
        self._last: Pair | None = None
        self.latency = (0.0, 0.0)
        """Largest time by which a frame came later, and by which its image was older than its odometry, s."""

    def connect(self) -> None:
        """Do nothing: what is lost comes again."""

    def begin(self, at_start: AtStart) -> Pair:
        """Wait until the vehicle stands at the start; see `LockStep.begin`."""
        self._topics.clear()
        newest = self._topics.settled(lambda odometry, _: at_start(odometry.message), FRAME_TIME / 10, "the reset")
        self._last, self.latency = newest, (0.0, 0.0)
        return newest

    def advance(self) -> Pair:
        """Wait for the end of the frame; see `LockStep.advance`."""
        assert self._last is not None
        due = self._last[0].stamp + FRAME
        self._topics.wait(due, self._last[1].stamp + 1)
        newest = self._topics.newest()
        assert newest is not None
        late, age = (newest[0].stamp - due) / 1e9, (newest[0].stamp - newest[1].stamp) / 1e9
        self.latency = max(self.latency[0], late), max(self.latency[1], age)
        self._last = newest
        return newest
