"""Advances a simulator by the wall clock with the last command that came; not deterministic."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.clock import Clock
from rclpy.node import Node

from ds_sim.ros.frame_jitter import FrameJitter
from ds_sim.simulator import FRAME_TIME, Command


class RealTimeLoop:
    """Calls `advance` 20 times a second with the last command.

    Args:
        node: node whose executor makes the calls.
        clock: steady clock; the node's own may be simulated time.
        advance: drives one frame.
    """

    def __init__(self, node: Node, clock: Clock, advance: Callable[[Command], None]) -> None:
        self._clock = clock
        self._advance = advance
        self._held: Command | None = None
        self._jitter: FrameJitter | None = None
        self._timer = node.create_timer(FRAME_TIME, self._tick, clock=clock)
        self._timer.cancel()

    def hold(self, command: Command) -> None:
        """Hold a command from now on; the first one starts the loop, as its driver may have to start first."""
        self._held = command
        if self._jitter is None:
            self._jitter = FrameJitter(FRAME_TIME, self._now())
            self._timer.reset()

    def end(self) -> str:
        """Stop, and return one line on how well time was kept; "" if the loop never ran."""
        summary = "" if self._jitter is None else str(self._jitter)
        self._held = self._jitter = None
        self._timer.cancel()
        return summary

    def _now(self) -> float:
        return float(self._clock.now().nanoseconds) * 1e-9

    def _tick(self) -> None:
        if self._held is not None and self._jitter is not None:
            self._jitter.beat(self._now())
            self._advance(self._held)
