"""A ROS domain of one's own, so that two graphs on one machine never hear each other."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

LOCKS = Path("/tmp")
"""Where every user of this machine looks; a folder of the user's own would not keep two users apart."""


class RosDomainError(RuntimeError):
    """No free domain."""


class RosDomain:
    """Holds a free domain until it is closed or its process ends, however that ends."""

    def __init__(self) -> None:
        for number in range(1, 102):  # 0 is everybody's default; up to 101 are safe on every system
            path = LOCKS / f"ds_ros_domain_{number}.lock"
            try:
                # Another user's file may be opened in /tmp, but not with O_CREAT.
                file = os.open(path, os.O_RDONLY | (0 if path.exists() else os.O_CREAT), 0o644)
            except OSError:
                continue
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                os.close(file)
                continue
            self.number = number
            self._file = file
            return
        raise RosDomainError("all ROS domains from 1 to 101 are in use: stop another campaign first")

    def close(self) -> None:
        """Give the domain back."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
