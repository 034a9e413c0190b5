# SPDX-License-Identifier: Apache-2.0
"""Plays a bag in recorded order at any rate, with pause and step; independent of ROS and of a terminal."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Protocol

from rosbags.interfaces import Connection

CLOCK_PERIOD = 0.025
"""Seconds of wall clock between two messages on /clock while the bag is silent: 40 Hz, as `ros2 bag play`."""
PAUSE, STEP, QUIT = "pause", "step", "quit"


class Output(Protocol):
    """Destination of a playback."""

    def publish(self, connection: Connection, raw: bytes) -> None:
        """Send a message exactly as it was recorded."""
        ...

    def clock(self, nanoseconds: int) -> None:
        """Publish the bag's time, ns."""
        ...


@dataclass(frozen=True, kw_only=True)
class Playback:
    """Summary of a playback.

    Attributes:
        messages: number of messages sent.
        moments: number of distinct times in the bag at which messages were sent.
        seconds: duration played, s of the bag's time.
        whole: False if a key ended the playback.
    """

    messages: int
    moments: int
    seconds: float
    whole: bool


@dataclass(frozen=True, kw_only=True)
class Controls:
    """The player's wall clock and keys.

    Attributes:
        now: steady clock, s.
        wait: waits for a key for at most the given number of seconds; returns PAUSE, STEP, QUIT or "".
        report: called with one line when the player pauses, steps or resumes.
    """

    now: Callable[[], float]
    wait: Callable[[float], str]
    report: Callable[[str], None]


def play(
    messages: Iterable[tuple[Connection, int, bytes]], output: Output, *, rate: float, controls: Controls
) -> Playback:
    """Play messages in order; those of one time are sent together, after that time was published on the clock.

    Args:
        messages: topic, time in ns, and serialised message, ordered by time.
        output: destination of the messages and the clock.
        rate: seconds of the bag per second of wall clock; infinity for as fast as possible.
        controls: wall clock and keys.
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

    def play(self, messages: Iterable[tuple[Connection, int, bytes]]) -> Playback:
        sent, moments, whole = 0, 0, True
        for time, group in itertools.groupby(messages, key=lambda message: message[1]):
            if not moments:
                self._first = self._last = time
                self._resume_from(time)
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
                self._controls.report(f"{self._seconds(time):.3f} s: {count} messages")
        return Playback(messages=sent, moments=moments, seconds=self._seconds(self._last), whole=whole)

    def _seconds(self, time: int) -> float:
        return (time - self._first) / 1e9

    def _resume_from(self, time: int) -> None:
        self._anchor_wall, self._anchor_bag = self._controls.now(), time

    def _until(self, time: int) -> bool:
        """Wait until a time of the bag is due or stepped to; False if the playback was ended."""
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
                self._resume_from(self._last)
                self._controls.report(f"{'paused' if self._paused else 'resumed'} at {self._seconds(self._last):.3f} s")
            elif key == STEP:
                if not self._paused:
                    self._paused = True
                    self._controls.report(f"paused at {self._seconds(self._last):.3f} s")
                return True
            elif not self._paused:
                if left <= CLOCK_PERIOD:
                    return True
                self._tick(time)

    def _tick(self, time: int) -> None:
        """Advance the clock while no message is due."""
        passed = (self._controls.now() - self._anchor_wall) * self._rate
        self._output.clock(min(time, self._anchor_bag + round(passed * 1e9)))
