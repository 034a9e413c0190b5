"""Frames by the wall clock: the last command holds, whatever a driver does meanwhile. Not deterministic."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.clock import Clock
from rclpy.node import Node

from ds_sim.ros.frame_jitter import FrameJitter
from ds_sim.simulator import FRAME_TIME, Command


class RealTimeLoop:
    """Calls `advance` 20 times a second with the command that was held last.

    Args:
        node: whose executor makes the calls.
        clock: steady; the node's own may be simulated time.
        advance: drives one frame.
    """

    def __init__(self, node: Node, clock: Clock, advance: Callable[[Command], None]) -> None:
        self._clock = clock
        self._advance = advance
        self._held: Command | None = None
        self._metronome: FrameJitter | None = None
        self._timer = node.create_timer(FRAME_TIME, self._tick, clock=clock)
        self._timer.cancel()

    def hold(self, command: Command) -> None:
        """A command came. Before the first one the vehicle stands: its driver may still be starting."""
        self._held = command
        if self._metronome is None:
            self._metronome = FrameJitter(FRAME_TIME, self._now())
            self._timer.reset()

    def end(self) -> str:
        """Stop, and tell how well time was kept; "" if it never ran."""
        told = "" if self._metronome is None else str(self._metronome)
        self._held = self._metronome = None
        self._timer.cancel()
        return told

    def _now(self) -> float:
        return float(self._clock.now().nanoseconds) * 1e-9

    def _tick(self) -> None:
        if self._held is not None and self._metronome is not None:
            self._metronome.beat(self._now())
            self._advance(self._held)
