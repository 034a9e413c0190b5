"""Matches commands of other stacks to the frames that they answer. No ROS: stamps are in nanoseconds."""

from __future__ import annotations

from collections import OrderedDict
from typing import Generic, TypeVar

FrameT = TypeVar("FrameT")
CommandT = TypeVar("CommandT")

MAX_FRAMES = 20
"""Number of frames kept; chosen: one second, as a later answer is too late in any case."""
MAX_AHEAD = 1_000_000_000
"""Largest lead of a command's stamp over the newest frame, ns; chosen: frames are 50 ms apart, and a command overtakes
its own frame by one at most."""


class StampMatcher(Generic[FrameT, CommandT]):
    """Pairs frames and commands, whichever arrives first.

    A command with the stamp of a frame answers that frame. A command without a stamp answers the newest unanswered
    frame, or else the next one to arrive. `FrameT` and `CommandT` are the types stored for a frame and for a command.
    """

    def __init__(self) -> None:
        self._frames: OrderedDict[int, FrameT] = OrderedDict()
        self._early: dict[int, CommandT] = {}
        self._unstamped: CommandT | None = None
        self._newest: int | None = None

    def frame(self, stamp: int, frame: FrameT) -> tuple[FrameT, CommandT] | None:
        """Add a frame; returns the pair if its command arrived before it."""
        self._newest = stamp
        self._frames[stamp] = frame
        self._frames.move_to_end(stamp)
        while len(self._frames) > MAX_FRAMES:
            self._frames.popitem(last=False)
        self._early = {s: c for s, c in self._early.items() if s >= stamp}
        command = self._early.pop(stamp, None)
        if command is None:
            command, self._unstamped = self._unstamped, None
        return None if command is None else (self._frames.pop(stamp), command)

    def command(self, stamp: int, command: CommandT) -> tuple[FrameT, CommandT] | None:
        """Add a command with the stamp of a frame, or 0 for none; returns the pair if its frame has arrived.

        Raises:
            KeyError: no unanswered frame has this stamp: the command is late, a duplicate, or unrelated to a frame.
        """
        if stamp == 0:
            if not self._frames:
                self._unstamped = command
                return None
            _, frame = self._frames.popitem()
            self._frames.clear()
            return frame, command
        if stamp in self._frames:
            return self._frames.pop(stamp), command
        if self._newest is not None and not self._newest < stamp <= self._newest + MAX_AHEAD:
            raise KeyError(stamp)
        self._early = {stamp: command} if self._newest is None else self._early | {stamp: command}
        return None
