# SPDX-License-Identifier: Apache-2.0
"""Records which steps are done, and for which inputs: a file per step holds the hash of its inputs and what it made."""

from __future__ import annotations

import fcntl
import hashlib
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from setup_tool.console import SetupError

UNFINISHED = "unfinished"
"""Stamp of a step that runs; at the start of a set-up, of one that was interrupted."""


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
    """Stamps in one folder, which is deleted together with the product.

    A stamp holds the hash of the step's inputs, then a line for each file that the step has made.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def is_done(self, step: str, inputs: str) -> bool:
        """Check whether the step was finished for these inputs (their hash), and all that it made is still there."""
        stamp = self._read(step)
        return stamp[0] == inputs and all(os.path.exists(product) for product in stamp[1:])

    def begin(self, step: str) -> bool:
        """Record that the step runs; True if it began once before and did not end."""
        was_interrupted = self._read(step)[0] == UNFINISHED
        self.folder.mkdir(parents=True, exist_ok=True)
        self._replace(step, UNFINISHED)
        return was_interrupted

    def finish(self, step: str, inputs: str, products: Sequence[Path]) -> None:
        """Stamp the step as done for these inputs (their hash).

        Raises:
            SetupError: a product of the step is not there.
        """
        if missing := [product for product in products if not product.exists()]:
            raise SetupError(f"{missing[0]} was not made, though nothing reported an error: see the log")
        self._replace(step, "\n".join([inputs, *map(str, products)]))

    def _read(self, step: str) -> list[str]:
        stamp = self.folder / step
        return stamp.read_text().split("\n") if stamp.is_file() else [""]

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
