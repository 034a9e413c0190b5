"""What drives: the protocol that every engine satisfies."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from ds_driver.closed_loop.drive_request import DriveRequest
from ds_sim.session import RunRecord

Watch = Callable[[int, float, float], None]
"""Called during a run with the number of frames, the driven part of the road in [0, 1], and the lateral position, m."""


class Engine(Protocol):
    """Drives roads on simulators with one driver and the autopilot, in this process or in others."""

    @property
    def capacity(self) -> int | None:
        """Drives at a time, on whatever simulators; None where each simulator takes as many as there are workers."""
        ...

    def drive(self, request: DriveRequest, watch: Watch | None = None) -> RunRecord:
        """Drive to an outcome; errors are outcomes too. Called from several threads.

        Args:
            request: what to drive, with the engine's driver or the autopilot.
            watch: called from another thread by an engine that gives feedback during a run.
        """
        ...

    def stop(self) -> None:
        """End every drive now, as CANCELLED."""
        ...
