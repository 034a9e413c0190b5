# SPDX-License-Identifier: Apache-2.0
"""Watches the commands of a run's driver: how long they take by the wall clock, and what is wrong with them."""

from __future__ import annotations

from ds_base.processes import RunningClock
from ds_sim.simulator import Reason

WARN_AFTER = 10
"""Commands with a wrong stamp before a warning is logged; chosen: half a second of a driver at 20 Hz."""
_RESTARTS = 1
"""Restarts of a driver accepted in one run; two drivers look like a restart at every other command."""


class CommandMonitor:
    """Watches the commands of one run in lock-step or real time."""

    def __init__(self) -> None:
        self._refused = ""
        self._awaited: object = None
        self._previous: object = None
        self._strays = 0
        self._sequence: int | None = None
        self._steps_back = 0

    def frame(self, stamp: object) -> None:
        """Record a new frame; a frame that is sent again keeps its stamp."""
        if stamp != self._awaited:
            self._previous, self._awaited = self._awaited, stamp
            self._strays = 0

    def command(self, sequence: int | None) -> None:
        """Record a command by its publisher's sequence number; None if the middleware has none."""
        if sequence is None:
            return
        if self._sequence is not None and sequence <= self._sequence:
            self._steps_back += 1
        self._sequence = sequence

    def stray(self, stamp: object) -> bool:
        """Record a command without the stamp of the last frame; return True if it should be logged.

        Repeated answers to the previous frame do not count: drivers answer a frame again that is sent again.
        """
        self._strays += stamp != self._previous
        return stamp != self._previous and self._strays == WARN_AFTER

    def refused(self, error: ValueError) -> None:
        """Record a command that no vehicle can execute."""
        self._refused = str(error)

    @property
    def two_drivers(self) -> bool:
        """Check whether the sequence numbers must come from two publishers, even after a restart during the run."""
        return self._steps_back > _RESTARTS

    def silence(self, seconds: float, step: int) -> tuple[str, Reason]:
        """Describe a wait, s, for the answer to a frame: the message and the reason of the run's result."""
        text = f"no command within {seconds:g} s after frame {step}"
        if self._refused:
            return f"{text}; the last command was refused: {self._refused}", Reason.COMMAND_REFUSED
        return (f"{text}; {self.complaint()}", Reason.WRONG_STAMP) if self._strays else (text, Reason.NONE)

    def complaint(self) -> str:
        """Describe commands that carry another stamp than the last image, and the remedy."""
        return (
            f"{self._strays} commands came since the last image, none with its stamp: copy the image's header into the "
            "command, or set sync to first"
        )


REPEAT_AFTER = 0.5
"""Time after which an unanswered first frame is sent again, s, for a driver that was not yet connected."""


class CommandWatchdog:
    """Measures the wait for a driver, at most a limit, s; in lock-step each frame begins a new one."""

    def __init__(self, limit: float, *, frames_wait: bool = True) -> None:
        self.limit = limit
        self._frames_wait = frames_wait
        self._repeatable = True
        self._clock = RunningClock()
        self._asked = self._sent = self._clock.now()

    def sent(self, step: int) -> None:
        """Note that a frame was sent; a first frame that is sent again gives its driver no more time."""
        self._sent = self._clock.now()
        self._repeatable = step == 0
        if self._frames_wait and not self._repeatable:
            self._asked = self._sent

    def heard(self) -> None:
        """Note that a command came."""
        self._asked = self._clock.now()
        self._repeatable = False

    @property
    def waited(self) -> float:
        """How long the driver has been silent, s."""
        return self._clock.now() - self._asked

    @property
    def is_over(self) -> bool:
        """True when the driver has been silent for too long."""
        return self.waited > self.limit

    @property
    def wants_repeat(self) -> bool:
        """Check whether the first frame should be sent again."""
        return self._repeatable and self._clock.now() - self._sent > REPEAT_AFTER
