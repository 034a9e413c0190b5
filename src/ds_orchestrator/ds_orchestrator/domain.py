"""A ROS domain of one's own, so that two graphs on one machine never hear each other."""

from __future__ import annotations

import fcntl
import tempfile
from pathlib import Path
from typing import IO


class DomainError(RuntimeError):
    """No free domain."""


class Domain:
    """Holds a free domain until it is closed or its process ends, however that ends."""

    def __init__(self) -> None:
        folder = Path(tempfile.gettempdir())
        for number in range(1, 102):  # 0 is everybody's default; up to 101 are safe on every system
            file = (folder / f"ds_ros_domain_{number}.lock").open("a")
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                file.close()
                continue
            self.number = number
            self._file: IO[str] = file
            return
        raise DomainError("all ROS domains from 1 to 101 are in use: stop another campaign first")

    def close(self) -> None:
        """Give the domain back."""
        self._file.close()
