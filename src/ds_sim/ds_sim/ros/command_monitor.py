"""Records faults in the commands of a run's driver, so that the result of a silent run can state the cause."""

from __future__ import annotations

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

    def silence(self, seconds: float) -> tuple[str, Reason]:
        """Describe a wait that ended without a usable command: the message and the reason of the run's result.

        Args:
            seconds: length of the wait.
        """
        text = f"no command within {seconds:g} s"
        if self._refused:
            return f"{text}; the last command was refused: {self._refused}", Reason.COMMAND_REFUSED
        return (f"{text}; {self.complaint()}", Reason.WRONG_STAMP) if self._strays else (text, Reason.NONE)

    def complaint(self) -> str:
        """Describe commands that carry another stamp than the last image, and the remedy."""
        return (
            f"{self._strays} commands came since the last image, none with its stamp: copy the image's header into the "
            "command, or set sync to first"
        )
