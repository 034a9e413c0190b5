# SPDX-License-Identifier: Apache-2.0
"""The one way into a folder of results, which may be a stranger's, and files that appear whole or not at all.

Who reads takes `read_file`, which follows no link; who writes holds `locked`, which refuses every link, FIFO and device
among the files of the folder before anything is written. The store has checks of its own.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path, PurePath

from ds_base.bounded_file import LARGEST_FILE, FileError, read_regular
from ds_base.errors import InputError, RunError

MOST_ENTRIES = 5_000_000
"""Files and folders; chosen: bags of a million executions, looked at within a minute."""
_OURS = re.compile(
    r"(campaign|drives)\.sqlite.*|\.(lock|engine\.json|live\.json).*|bags|logs|maps|evaluation|real|drives|tables|worse"
    r"|.*\.(json|html|md|csv|tex|png|partial)"
)
"""Names of what verbs read and write in a folder; whatever else is there is left alone."""
PARTIAL = re.compile(r"\..+\.(\d+)\.partial")
"""Names of files that are being written, with the process that writes."""


class StoreError(InputError):
    """Folder or file of results that cannot be read or written; one line with the remedy."""


_entered: set[Path] = set()
"""Folders of results that this process writes in; a link below one would lead out of it."""


class LockError(RunError):
    """Folder that another process uses, or that cannot be written."""


def read_file(folder: Path, name: str | PurePath, largest: int = LARGEST_FILE) -> bytes:
    """Read a file of at most so many bytes inside a folder, under a name of the program's own.

    One that cannot be read, or is a link, is a StoreError, and none a FileNotFoundError.
    """
    path = folder / name
    try:
        for parent in PurePath(name).parents[:-1]:
            if (folder / parent).is_symlink():
                raise StoreError(f"{folder / parent} is a link, expected a folder: remove it")
        if path.is_symlink():
            raise StoreError(f"{path} is a link, expected a file: remove it")
        return read_regular(path, largest, follow_links=False)
    except FileNotFoundError:
        raise
    except FileError as error:
        raise StoreError(f"{path}: {error}") from None
    except OSError as error:
        raise StoreError(f"{path} cannot be opened ({error.strerror}): check its permissions") from None


def check_name(folder: Path) -> None:
    """Refuse a folder whose name is no UTF-8 text, which no report or page could show."""
    try:
        str(folder).encode()
    except UnicodeEncodeError:
        raise StoreError(f"{os.fsencode(folder)!r}: the name is not UTF-8: rename the folder") from None


def check_inside(path: Path) -> None:
    """Refuse a path below a folder that `check_folder` has checked, in which a folder is a link by now."""
    parents = list(path.absolute().parents)
    below = max((k for k, parent in enumerate(parents) if parent in _entered), default=0)
    for parent in parents[:below]:
        if parent.is_symlink():
            raise StoreError(f"{parent} is a link, and could lead outside the folder of results: remove it")


def check_folder(folder: Path) -> list[str]:
    """Refuse a folder in which a write would follow a link out of it, or wait for a FIFO; remember it for later writes.

    Returns the paths of half-written files whose processes have ended on this machine.
    """
    check_name(folder)
    check_inside(folder / "file")
    _entered.add(folder.absolute())
    half_written = []
    try:
        entries = [entry for entry in os.scandir(folder) if _OURS.fullmatch(entry.name)]
        left = MOST_ENTRIES
        while entries:
            entry = entries.pop()
            left -= 1
            if left < 0:
                raise StoreError(f"{folder} has more than {MOST_ENTRIES} files, the limit for a campaign")
            if entry.is_symlink():
                raise StoreError(f"{entry.path} is a link, and could lead outside the campaign's folder: remove it")
            if entry.is_dir(follow_symlinks=False):
                with os.scandir(entry.path) as inside:
                    entries += islice(inside, MOST_ENTRIES)
            elif not entry.is_file(follow_symlinks=False):
                raise StoreError(f"{entry.path} is neither a file nor a folder: remove it")
            elif (name := PARTIAL.fullmatch(entry.name)) and not Path("/proc", name[1]).exists():
                half_written.append(entry.path)
    except OSError as error:
        raise StoreError(f"{folder} cannot be read ({error.strerror}): check its permissions") from None
    return half_written


def make_parents(path: Path) -> None:
    """Create the folders above a file or folder that a user named; errors as in `check_inside`, and `OSError`."""
    check_inside(path)
    path.parent.mkdir(parents=True, exist_ok=True)


def place_folder(finished: Path, folder: Path) -> None:
    """Move a folder that was made under another name to its own, to stay there; errors as in `make_parents`."""
    make_parents(folder)
    finished.rename(folder)
    synchronise(folder.parent)


def synchronise(path: Path) -> None:
    """Wait until the disk has a file's content, or the names in a folder; otherwise a power cut may lose them."""
    file = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        os.fsync(file)
    except OSError as error:
        if error.errno != errno.EINVAL:  # some file systems cannot do it for folders
            raise OSError(error.errno, error.strerror, str(path)) from None
    finally:
        os.close(file)


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


def enter_folder(folder: Path) -> None:
    """Create a folder to write in, unless it is there, or raise a StoreError; later writes below it refuse links."""
    check_inside(folder / "file")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise StoreError(f"{folder} is a file, expected a folder: choose another --out") from None
    except OSError as error:
        raise StoreError(f"{folder} cannot be created ({error.strerror}): choose another --out") from None
    _entered.add(folder.absolute())


def make_folder(folder: Path) -> None:
    """Create a folder for results, or check the one that is there; errors as in `enter_folder` and `check_folder`."""
    enter_folder(folder)
    check_folder(folder)


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Check a folder and lock it, to write there; the kernel releases the lock when this process ends.

    Files that a killed process or a power cut left half-written are removed. A LockError says that another process
    holds the lock, or that the folder cannot be written; for other errors see `check_folder`.
    """
    half_written = check_folder(folder)
    try:
        file = os.open(folder / ".lock", os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644)
    except OSError as error:
        raise LockError(
            f"{folder} cannot be written ({error.strerror}): check its permissions and disk, or choose another --out"
        ) from None
    try:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise LockError(f"{folder} is in use by another run: wait for it, or choose another --out") from None
        except OSError as error:
            raise LockError(f"{folder} cannot be locked ({error.strerror}): choose an --out on a local disk") from None
        for path in half_written:
            Path(path).unlink(missing_ok=True)
        yield
    finally:
        os.close(file)
