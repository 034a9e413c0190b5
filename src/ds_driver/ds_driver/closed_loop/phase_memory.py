"""Shares with another process what this one is doing, so that it can be found hanging whatever it hangs in."""

from __future__ import annotations

import mmap
import os
import struct

from ds_driver.closed_loop.interleaved_drives import Phase

_LAYOUT = struct.Struct("<QqI")


class PhaseMemory:
    """A few bytes that one process writes and another reads.

    Args:
        file: descriptor of the memory, from `descriptor` of the creating side; None to create it.

    Attributes:
        descriptor: file descriptor, to be passed on to the other process.
    """

    def __init__(self, file: int | None = None) -> None:
        if file is None:
            file = os.memfd_create("phase")
            os.ftruncate(file, _LAYOUT.size)
        self.descriptor = file
        self._memory = mmap.mmap(file, _LAYOUT.size)
        self._changes = 0

    def note(self, phase: Phase, key: int) -> None:
        """Write that a phase of a drive has begun."""
        self._changes += 1
        _LAYOUT.pack_into(self._memory, 0, self._changes, key, phase)

    def read(self) -> tuple[int, int, Phase]:
        """Return the number of phases so far, the key of the drive, and the phase."""
        changes, key, phase = _LAYOUT.unpack_from(self._memory, 0)
        return changes, key, Phase(phase)

    def close(self) -> None:
        """Release the memory."""
        self._memory.close()
        os.close(self.descriptor)
