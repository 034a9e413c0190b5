# SPDX-License-Identifier: Apache-2.0
"""Records which steps are done, and for which inputs: a file per step holds the hash of its inputs."""

from __future__ import annotations

import fcntl
import hashlib
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

UNFINISHED = "unfinished"
"""File that names the running step; if present at the start, that step was interrupted."""


def digest(parts: Iterable[str | bytes | Path]) -> str:
    """Hash texts and the contents of files; a missing file counts as such, and order matters."""
    whole = hashlib.sha256()
    for part in parts:
        if isinstance(part, Path):
            content = part.read_bytes() if part.is_file() else b"missing"
            part = f"{part.name}\0{len(content)}\0".encode() + content
        elif isinstance(part, str):
            part = part.encode()
        whole.update(f"{len(part)}\0".encode() + part)
    return whole.hexdigest()


class Stamps:
    """Stamps in one folder, which is deleted together with the product."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def is_done(self, step: str, inputs: str) -> bool:
        """Check whether the step was finished for these inputs (their hash)."""
        stamp = self.folder / step
        return stamp.is_file() and stamp.read_text() == inputs

    def exists(self, step: str) -> bool:
        """Check whether the step was finished for any inputs."""
        return (self.folder / step).is_file()

    def begin(self, step: str) -> None:
        """Remove the step's stamp, and record that it runs."""
        self.folder.mkdir(parents=True, exist_ok=True)
        self.clear(step)
        self._replace(UNFINISHED, step)

    def finish(self, step: str, inputs: str) -> None:
        """Stamp the step as done for these inputs (their hash)."""
        self._replace(step, inputs)
        self.clear(UNFINISHED)

    def clear(self, step: str) -> None:
        """Forget that a step was done, or, with `UNFINISHED`, that one was interrupted."""
        (self.folder / step).unlink(missing_ok=True)

    def unfinished(self) -> str | None:
        """Name of the interrupted step, if any."""
        note = self.folder / UNFINISHED
        return note.read_text() if note.is_file() else None

    def _replace(self, name: str, text: str) -> None:
        new = self.folder / f"{name}.new"
        new.write_text(text)
        os.replace(new, self.folder / name)


@contextmanager
def one_at_a_time(folder: Path, on_wait: Callable[[], None]) -> Iterator[int]:
    """Hold the folder's lock, which ends with the last process that has the yielded descriptor open.

    Args:
        folder: existing folder; the lock is on the folder itself, no file is created.
        on_wait: called once if another process holds the lock, before waiting for it.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            on_wait()
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield descriptor
    finally:
        os.close(descriptor)
