# SPDX-License-Identifier: Apache-2.0
"""Reads files and JSON that a stranger may have sent: regular files of bounded size, never a FIFO, device or folder."""

from __future__ import annotations

import hashlib
import json
import math
import os
import stat
from collections.abc import Iterable
from pathlib import Path
from typing import Any, BinaryIO

from ds_base.errors import InputError

LARGEST_FILE = 16 * 2**20
"""Bytes of a file that is read at once; chosen: a hundred times the usual one."""
LARGEST_INTEGER = 2**64
"""Integers of JSON and YAML are smaller, so that each is a `float`, too."""
LFS_POINTER = b"version https://git-lfs.github.com/spec/"
"""Beginning of what Git writes in the place of a large file that it has not fetched."""


class FileError(InputError):
    """File that is not read; the message is one line without the file's name."""


def open_regular(path: Path, *, follow_links: bool = True) -> BinaryIO:
    """Open a regular file for reading, or raise a FileError or OSError; never waits, as a FIFO would make it."""
    # Opening some devices has effects, so the kind is known before; the second look is at what was opened.
    if not stat.S_ISREG(path.stat(follow_symlinks=follow_links).st_mode):
        raise FileError("not a regular file: give the path of one")
    flags = os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | (0 if follow_links else os.O_NOFOLLOW)
    file = os.fdopen(os.open(path, flags), "rb")
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise FileError("not a regular file: give the path of one")
    if file.read(len(LFS_POINTER)) == LFS_POINTER:
        file.close()
        raise FileError("a pointer of Git LFS in the place of the file: fetch it with `git lfs pull`")
    file.seek(0)
    return file


def read_regular(path: Path, largest: int = LARGEST_FILE, *, follow_links: bool = True) -> bytes:
    """Read a regular file; a longer one than so many bytes is a FileError, the rest is as in `open_regular`."""
    with open_regular(path, follow_links=follow_links) as file:
        content = file.read(largest + 1)
    if len(content) > largest:
        raise FileError(f"longer than {largest / 2**20:g} MiB, the limit for such a file")
    return content


def read_words(path: Path, largest: int = LARGEST_FILE) -> str:
    """Read a regular file of UTF-8 text; other text is a FileError, the rest is as in `read_regular`."""
    try:
        return read_regular(path, largest).decode()
    except UnicodeDecodeError as error:
        raise FileError(f"not UTF-8 text (byte {error.start})") from None


def sha256_of(files: Iterable[Path]) -> str:
    """SHA-256 of the content of regular files, one after the other; errors as in `open_regular`."""
    digest = hashlib.sha256()
    for path in files:
        with open_regular(path) as file:
            while block := file.read(2**20):
                digest.update(block)
    return digest.hexdigest()


def load_json(text: str | bytes) -> Any:
    """Build the value of a JSON document, with integers beyond 64 bits infinite, or raise a FileError of one line."""
    try:
        return json.loads(text, parse_int=_integer)
    except FileError:
        raise
    except RecursionError:
        raise FileError("not JSON (nested too deeply)") from None
    except ValueError as error:
        raise FileError(f"not JSON ({' '.join(str(error).split())[:150]})") from None


def read_json(path: Path, largest: int = LARGEST_FILE) -> Any:
    """Read a JSON file; arguments and errors as in `read_regular`, errors as in `load_json`, too."""
    return load_json(read_regular(path, largest))


def _integer(digits: str) -> int | float:
    """An integer; infinity beyond 64 bits, as of a float of so many digits, which every reader refuses as no number."""
    if len(digits) <= 20 and abs(int(digits)) < LARGEST_INTEGER:
        return int(digits)
    return -math.inf if digits[0] == "-" else math.inf
