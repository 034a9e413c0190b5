"""Removes the shared-memory files that killed processes of Fast DDS leave in /dev/shm."""

from __future__ import annotations

import fcntl
import os
import time
from collections import defaultdict
from pathlib import Path

FOLDER = Path("/dev/shm")
OLDER_THAN = 10.0
"""s; a younger file may belong to a process that has created it but not mapped it yet."""
_PREFIXES = ("fastrtps_", "sem.fastrtps_")


def remove_leftovers(folder: Path = FOLDER, *, older_than: float = OLDER_THAN) -> int:
    """Remove segments and ports that no process maps, opens or locks.

    Each consists of several files (`fastrtps_ID`, `fastrtps_ID_el`, `sem.fastrtps_ID_mutex`), which are kept or removed
    together. Only files of this user are touched.

    Args:
        folder: folder of the shared-memory files.
        older_than: age in s below which a file is kept.

    Returns:
        Number of removed files.
    """
    groups: dict[str, list[Path]] = defaultdict(list)
    for path in folder.glob("*fastrtps_*"):
        if path.name.startswith(_PREFIXES):
            groups[_group(path.name)].append(path)
    candidates = [paths for paths in groups.values() if all(_is_own_and_old(path, older_than) for path in paths)]
    if not candidates:
        return 0
    used = _used_files(folder)
    removed = 0
    for paths in candidates:
        if not used.isdisjoint(path.name for path in paths) or any(_is_locked(path) for path in paths):
            continue
        for path in paths:
            path.unlink(missing_ok=True)
            removed += 1
    return removed


def _group(name: str) -> str:
    """Name the segment or port to which a file belongs."""
    name = name.removeprefix("sem.").removeprefix("fastrtps_")
    return name.partition("_")[0]


def _is_own_and_old(path: Path, older_than: float) -> bool:
    try:
        status = path.lstat()
    except OSError:
        return False
    return status.st_uid == os.getuid() and time.time() - max(status.st_mtime, status.st_ctime) > older_than


def _used_files(folder: Path) -> set[str]:
    """List the files of a folder that a visible process maps or has open."""
    prefix = f"{folder}/"
    used: set[str] = set()
    for process in Path("/proc").glob("[0-9]*"):
        try:
            lines = (process / "maps").read_text(errors="replace").splitlines()
            used.update(line.partition(prefix)[2] for line in lines if prefix in line)
            targets = [os.readlink(link) for link in (process / "fd").iterdir()]
            used.update(target.removeprefix(prefix) for target in targets if target.startswith(prefix))
        except OSError:  # the process has ended, or is another user's, whose files are locked while in use
            continue
    return used


def _is_locked(path: Path) -> bool:
    """Check whether a process holds a lock on a file, even one in another container."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    except OSError:
        return not path.is_symlink() and path.exists()
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(descriptor)
    return False
