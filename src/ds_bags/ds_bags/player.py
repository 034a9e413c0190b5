"""Plays a bag in its own order at any rate, pauses and steps; knows neither ROS nor a terminal."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Protocol

from rosbags.interfaces import Connection

CLOCK_PERIOD = 0.025
"""s of wall clock between two times on /clock while the bag is silent: 40 Hz, the default of `ros2 bag play`."""
PAUSE, STEP, QUIT = "pause", "step", "quit"


class Output(Protocol):
    """Where a bag is played to."""

    def publish(self, connection: Connection, raw: bytes) -> None:
        """Send a message as it was recorded."""
        ...

    def clock(self, nanoseconds: int) -> None:
        """Tell the time of the bag."""
        ...


@dataclass(frozen=True, kw_only=True)
class Played:
    """What was sent.

    Attributes:
        messages: how many.
        moments: at how many different times of the bag.
        seconds: of the bag.
        whole: False if it was ended by a key.
    """

    messages: int
    moments: int
    seconds: float
    whole: bool


@dataclass(frozen=True, kw_only=True)
class Controls:
    """The player's wall clock and keys.

    Attributes:
        now: s, steady.
        wait: waits at most so many s, or less when a key comes: PAUSE, STEP, QUIT, or "".
        tell: is told in one line when the player pauses, steps or goes on.
    """

    now: Callable[[], float]
    wait: Callable[[float], str]
    tell: Callable[[str], None]


def play(
    messages: Iterable[tuple[Connection, int, bytes]], output: Output, *, rate: float, controls: Controls
) -> Played:
    """Play messages in their order; those of one time go out together, after that time has gone to the clock.

    Args:
        messages: topic, time in ns, and serialised message, in the order of time.
        output: where to.
        rate: bag seconds per second of wall clock, or infinity for as fast as it goes.
        controls: clock and keys.
    """
    return _Player(output, rate, controls).play(messages)


class _Player:
    def __init__(self, output: Output, rate: float, controls: Controls) -> None:
        self._output = output
        self._rate = rate
        self._controls = controls
        self._paused = False
        self._first = self._last = 0
        self._anchor_wall = 0.0
        self._anchor_bag = 0

    def play(self, messages: Iterable[tuple[Connection, int, bytes]]) -> Played:
        sent, moments, whole = 0, 0, True
        for time, group in itertools.groupby(messages, key=lambda message: message[1]):
            if not moments:
                self._first = self._last = time
                self._go_on_from(time)
            if not self._until(time):
                whole = False
                break
            self._output.clock(time)
            count = 0
            for connection, _, raw in group:
                self._output.publish(connection, raw)
                count += 1
            self._last = time
            sent, moments = sent + count, moments + 1
            if self._paused:
                self._controls.tell(f"{self._seconds(time):.3f} s: {count} messages")
        return Played(messages=sent, moments=moments, seconds=self._seconds(self._last), whole=whole)

    def _seconds(self, time: int) -> float:
        return (time - self._first) / 1e9

    def _go_on_from(self, time: int) -> None:
        self._anchor_wall, self._anchor_bag = self._controls.now(), time

    def _until(self, time: int) -> bool:
        """Wait until a moment is due, or is stepped to; False to end."""
        while True:
            left = 0.0
            if not self._paused and math.isfinite(self._rate):
                due = self._anchor_wall + (time - self._anchor_bag) / 1e9 / self._rate
                left = due - self._controls.now()
            key = self._controls.wait(CLOCK_PERIOD if self._paused else min(max(left, 0.0), CLOCK_PERIOD))
            if key == QUIT:
                return False
            if key == PAUSE:
                self._paused = not self._paused
                self._go_on_from(self._last)
                self._controls.tell(f"{'paused' if self._paused else 'goes on'} at {self._seconds(self._last):.3f} s")
            elif key == STEP:
                if not self._paused:
                    self._paused = True
                    self._controls.tell(f"paused at {self._seconds(self._last):.3f} s")
                return True
            elif not self._paused:
                if left <= CLOCK_PERIOD:
                    return True
                self._tick(time)

    def _tick(self, time: int) -> None:
        """The clock goes on while nothing is sent."""
        passed = (self._controls.now() - self._anchor_wall) * self._rate
        self._output.clock(min(time, self._anchor_bag + round(passed * 1e9)))
