"""Names and places of bags on disk, and the error that every reader and writer of bags raises."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal, get_args

Level = Literal["telemetry", "compressed", "raw"]
"""What a bag holds: everything but images, images as JPEG too, or images bit by bit."""
LEVELS: tuple[Level, ...] = get_args(Level)
TRANSLATED = "sim2real"
"""First part of the topics of images as the driver saw them, in place of `camera`; and fact of a bag whose images were
translated later: the digest of the generator."""
LONGEST_NAME = 200
"""Bytes of a bag's name; chosen: with `.mcap` and a hidden folder's additions, a file's name has at most 255."""


class BagError(ValueError):
    """A bag that cannot be written or read."""


def partial_path(folder: Path) -> Path:
    """Folder in which a run's bag grows until it is whole."""
    return folder.with_name(f".{folder.name}.partial")


def image_spool_path(folder: Path) -> Path:
    """Bag in which a run's images are recorded as they come, until the run's own bag is written."""
    return folder.with_name(f".{folder.name}.seen") / folder.name


def bag_name(name: object) -> str:
    """Check the name of a bag or of a file of it that was read from a file, before it becomes part of a path.

    Raises:
        BagError: it is not a plain, visible name: it could lead out of the folder that it belongs in.
    """
    plain = isinstance(name, str) and name.isprintable() and not set(name) & {"/", "\\"}
    if isinstance(name, str) and plain and name and name[0] != "." and len(name.encode()) <= LONGEST_NAME:
        return name
    shown = repr(name if len(str(name)) <= 60 else f"{str(name)[:60]}...")
    raise BagError(f"{shown} is not a plain name of a file or folder: nothing was written, ask for another copy")


@contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """Make a folder that appears whole or not at all, beside others that may be in the making.

    Args:
        folder: to make; must not exist. Its parents are made.

    Yields:
        A path of the same name in a new hidden folder beside it, to make the folder at; it is moved when all is well.

    Raises:
        BagError: the folder exists.
    """
    if os.path.lexists(folder):
        raise BagError(f"{folder} exists already: choose another --out")
    folder.parent.mkdir(parents=True, exist_ok=True)
    # A name of its own: a hidden folder that is there already belongs to somebody else.
    hidden = Path(tempfile.mkdtemp(prefix=f".{folder.name[:100]}.", suffix=".partial", dir=folder.parent))
    try:
        yield hidden / folder.name
        (hidden / folder.name).rename(folder)
    finally:
        shutil.rmtree(hidden, ignore_errors=True)
