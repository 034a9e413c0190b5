"""One process at a time in a campaign's folder, however the last one ended."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class LockError(RuntimeError):
    """A folder that another process uses."""


@contextmanager
def only_one(folder: Path) -> Iterator[None]:
    """Hold a folder; the kernel lets go of it when this process ends.

    Raises:
        LockError: another process holds it, or nothing can be written there.
    """
    try:
        file = os.open(folder / ".lock", os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        raise LockError(
            f"{folder} cannot be written ({error.strerror}): check its permissions and disk, or choose another --out"
        ) from None
    try:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise LockError(f"{folder} is in use by another run: wait for it, or choose another --out") from None
        yield
    finally:
        os.close(file)
