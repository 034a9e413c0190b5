# SPDX-License-Identifier: Apache-2.0
"""Writes files that appear whole or not at all, inside the folder that the user named."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ds_base.folder_files import StoreError, make_parents, synchronise


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a path to write to, which replaces `path` at the end; an error, kill or power cut leaves what was there.

    Processes that write the same file at once do not disturb each other: the last one wins. A link is replaced, not
    followed; the folder is created if missing. A device, or a folder that is a link, is a StoreError: `check_inside`.
    """
    make_parents(path)
    if path.exists() and not path.is_file():
        raise StoreError(f"{path} is neither a file nor a link to one: choose another name")
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    partial.unlink(missing_ok=True)
    try:
        os.close(os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666))
        yield partial
        synchronise(partial)  # a name that is moved may get there before the content
        partial.replace(path)
        synchronise(path.parent)
    finally:
        partial.unlink(missing_ok=True)


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file that appears whole or not at all; text as UTF-8."""
    with whole_file(path) as partial:
        partial.write_bytes(content.encode() if isinstance(content, str) else content)


def write_json(path: Path, value: object) -> None:
    """Write finite JSON values, indented, to a file that appears whole or not at all."""
    write_whole(path, json.dumps(value, indent=1, allow_nan=False) + "\n")
