"""Notes what is wrong with the commands of a run's driver, so that the result of a silent run can say it."""

from __future__ import annotations

from ds_sim.simulator import Reason

WARN_AFTER = 10
"""Commands without the awaited stamp after which the log says so; chosen: half a second of a driver at 20 Hz."""
_RESTARTS = 1
"""Restarts of a driver in one run; two drivers take turns, and look like a restart with every other command."""


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
        """Note a new frame; one that is sent again keeps its stamp."""
        if stamp != self._awaited:
            self._previous, self._awaited = self._awaited, stamp
            self._strays = 0

    def command(self, sequence: int | None) -> None:
        """Note any command, by the sequence number that its publisher gave it; None if the middleware has none."""
        if sequence is None:
            return
        if self._sequence is not None and sequence <= self._sequence:
            self._steps_back += 1
        self._sequence = sequence

    def stray(self, stamp: object) -> bool:
        """Note a command without the stamp of the last frame; True when that is worth a line in the log.

        A second answer to the frame before is none: drivers answer a frame that was sent again once more.
        """
        self._strays += stamp != self._previous
        return stamp != self._previous and self._strays == WARN_AFTER

    def refused(self, error: ValueError) -> None:
        """Note a command that no vehicle can execute."""
        self._refused = str(error)

    @property
    def two_drivers(self) -> bool:
        """True when the sequence numbers cannot come from one publisher, even if it was restarted during the run."""
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
        """Say what is wrong with commands that carry another stamp than the last image."""
        return (
            f"{self._strays} commands came since the last image, none with its stamp: copy the image's header into the "
            "command, or set sync to first"
        )
