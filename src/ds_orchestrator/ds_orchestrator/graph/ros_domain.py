"""Reserves a ROS domain for each graph, so that graphs on one machine do not discover each other."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

LOCKS = Path("/tmp")
"""Shared by all users of the machine; a folder per user would not keep two users apart."""


class RosDomainError(RuntimeError):
    """No free ROS domain."""


class RosDomain:
    """Reserves a free domain until it is closed or its process ends, by whatever signal.

    Attributes:
        number: reserved domain, 1 to 101.

    Raises:
        RosDomainError: all domains are in use.
    """

    def __init__(self) -> None:
        for number in range(1, 102):  # 0 is ROS's default; up to 101 are safe on every system
            path = LOCKS / f"ds_ros_domain_{number}.lock"
            try:
                # Another user's file in /tmp may be opened, but not with O_CREAT (fs.protected_regular).
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
        """Release the domain."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
