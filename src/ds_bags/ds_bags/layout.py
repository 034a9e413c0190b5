"""Names and places of bags on disk, and the one error that every reader and writer of them raises."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, get_args

Level = Literal["telemetry", "compressed", "raw"]
"""What a bag holds: everything but images, images as JPEG too, or images bit by bit."""


LEVELS: tuple[Level, ...] = get_args(Level)


class BagError(ValueError):
    """A bag that cannot be written or read."""


def partial_path(folder: Path) -> Path:
    """Where a bag lies until it is whole."""
    return folder.with_name(f".{folder.name}.partial")


def image_spool_path(folder: Path) -> Path:
    """Where the images of a run are kept as they come, until its bag is written; a bag too."""
    return folder.with_name(f".{folder.name}.seen") / folder.name
