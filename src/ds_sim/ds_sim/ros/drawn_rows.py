"""Chooses the rows of its images that a simulator draws in a run: those that somebody looks at."""

from __future__ import annotations

from collections.abc import Callable

from ds_sim.ros.frame_publisher import FramePublisher
from ds_sim.simulator import DrawsRows, Simulator, SimulatorSpec

RowsSeen = Callable[[SimulatorSpec], tuple[int, int] | None]


class DrawnRows:
    """Leaves out rows that only the driver in the simulator's own process would get, and does not look at.

    Args:
        simulator: any simulator; one that does not satisfy `DrawsRows` draws all rows.
        frames: publishers of its frames.
    """

    def __init__(self, simulator: Simulator, frames: FramePublisher) -> None:
        self._simulator = simulator
        self._frames = frames
        self._seen: tuple[int, int] | None = None
        self._own = 0

    def draw_for(self, rows_seen: RowsSeen, *, subscriptions: int) -> None:
        """Draw from the next run on what the driver in this process looks at.

        Args:
            rows_seen: maps the simulator's description to first row and end of these rows; to None for all rows.
            subscriptions: subscriptions of that driver to `frame`.
        """
        self._seen, self._own = rows_seen(self._simulator.spec), subscriptions

    def choose(self) -> None:
        """Choose the rows of the run that begins; a subscriber that comes during a run gets whole images after it."""
        if self._seen is None or not isinstance(self._simulator, DrawsRows):
            return
        whole = (0, self._simulator.spec.camera.height_px)
        watched = self._frames.viewers > self._own
        self._simulator.draw_rows(*(whole if watched else self._seen))
