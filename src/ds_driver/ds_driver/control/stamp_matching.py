"""Finds the frame that a command of another stack answers. No ROS: stamps are nanoseconds."""

from __future__ import annotations

from collections import OrderedDict
from typing import Generic, TypeVar

FrameT = TypeVar("FrameT")
CommandT = TypeVar("CommandT")

FRAMES = 20
"""Frames that are remembered: one second; chosen, a later answer is too late in any case."""
AHEAD = 1_000_000_000
"""Nanoseconds by which an answer's stamp may be ahead of the newest frame here; chosen: frames are 50 ms apart, and an
answer overtakes its own frame by one at most."""


class StampMatcher(Generic[FrameT, CommandT]):
    """Pairs frames and commands, whichever comes first.

    A command with a frame's stamp answers that frame. A command without a stamp answers the newest frame that has no
    answer yet, or the next one that comes.

    Args:
        FrameT: what is remembered of a frame.
        CommandT: what is remembered of a command.
    """

    def __init__(self) -> None:
        self._frames: OrderedDict[int, FrameT] = OrderedDict()
        self._early: dict[int, CommandT] = {}
        self._unstamped: CommandT | None = None
        self._newest: int | None = None

    def frame(self, stamp: int, frame: FrameT) -> tuple[FrameT, CommandT] | None:
        """A frame came; the pair if its answer was here before it."""
        self._newest = stamp
        self._frames[stamp] = frame
        self._frames.move_to_end(stamp)
        while len(self._frames) > FRAMES:
            self._frames.popitem(last=False)
        self._early = {s: c for s, c in self._early.items() if s >= stamp}
        command = self._early.pop(stamp, None)
        if command is None:
            command, self._unstamped = self._unstamped, None
        return None if command is None else (self._frames.pop(stamp), command)

    def command(self, stamp: int, command: CommandT) -> tuple[FrameT, CommandT] | None:
        """A command came, with a frame's stamp or with 0; the pair if its frame is here.

        Raises:
            KeyError: the stamp is no open frame's: late, a second answer, or no stamp of a frame at all.
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
        if self._newest is not None and not self._newest < stamp <= self._newest + AHEAD:
            raise KeyError(stamp)
        self._early = {stamp: command} if self._newest is None else self._early | {stamp: command}
        return None
