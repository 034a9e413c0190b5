# SPDX-License-Identifier: Apache-2.0
"""A disk that fails, or keeps a record of what reaches it, for every process into which `disk.c` is preloaded."""

from __future__ import annotations

import ctypes
import errno
import mmap
import os
import re
import shutil
import sqlite3
import subprocess
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

HERE = Path(__file__).parent
KINDS = ("write", "sync", "rename", "open", "mkdir")
"""As the enumeration in `disk.c`."""
ERRORS = {"full": errno.ENOSPC, "broken": errno.EIO, "short": 0}
needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")


class State(ctypes.Structure):
    """As `struct state` in `disk.c`."""

    _fields_ = (
        ("folder", ctypes.c_char * 1024),
        ("record", ctypes.c_char * 1024),
        ("kind", ctypes.c_int),
        ("error", ctypes.c_int),
        ("stays", ctypes.c_int),
        ("lock", ctypes.c_int),
        ("nth", ctypes.c_long),
        ("counts", ctypes.c_long * len(KINDS)),
    )


class Disk:
    """What preloaded processes share; it keeps its own files in `scratch`."""

    def __init__(self, scratch: Path) -> None:
        self._path, self._library, self._record = scratch / "disk.state", scratch / "disk.so", scratch / "disk.record"
        if not self._library.exists():
            command = ["cc", "-shared", "-fPIC", "-O1", "-o", str(self._library), str(HERE / "disk.c"), "-ldl"]
            subprocess.run(command, check=True)
        self._path.touch()
        with self._path.open("r+b") as file:
            file.truncate(ctypes.sizeof(State))
            self._state = State.from_buffer(mmap.mmap(file.fileno(), ctypes.sizeof(State)))

    @property
    def environment(self) -> dict[str, str]:
        """Environment of a process that writes to this disk."""
        path = os.pathsep.join([str(HERE.parent.parent), os.environ.get("PYTHONPATH", "")])
        return os.environ | {"LD_PRELOAD": str(self._library), "DISK_STATE": str(self._path), "PYTHONPATH": path}

    def arm(self, folder: Path, kind: int = -1, nth: int = 0, error: str = "full", stays: bool = False) -> None:
        """Let the Nth call of a kind below a folder fail, and all later ones if it `stays`; none with the defaults."""
        new = State(os.fsencode(folder), b"", kind, ERRORS[error], stays, 0, nth)
        ctypes.memmove(ctypes.byref(self._state), ctypes.byref(new), ctypes.sizeof(State))

    def record(self, folder: Path) -> Path:
        """Keep a record of what is written below a folder, in the file that is returned."""
        self.arm(folder)
        self._record.write_bytes(b"")
        self._state.record = os.fsencode(self._record)
        return self._record

    def disarm(self) -> list[int]:
        """Let nothing fail any more; returns the number of calls of each kind."""
        counts = list(self._state.counts)
        self._state.folder = self._state.record = b""
        return counts


def content(folder: Path) -> dict[str, Any]:
    """Every result in a folder, hidden files included, but logs and durations; of the store, the rows."""
    files: dict[str, Any] = {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != "campaign.sqlite" and path.parts[len(folder.parts)] != "logs"
    }
    files["report.html"] = re.sub(b"Wall-clock time.*", b"", files.get("report.html", b""))
    with closing(sqlite3.connect(folder / "campaign.sqlite")) as db:
        for table in ("tests", "executions", "errors", "given_up", "searches", "results", "gates"):
            files[table] = sorted(db.execute(f"SELECT * FROM {table}"), key=repr)
    return files


def differences(folder: Path, whole: Path) -> list[str]:
    """What a campaign has otherwise than an undisturbed one."""
    now, expected = content(folder), content(whole)
    return [f"differs: {one}" for one in sorted(expected.keys() | now) if expected.get(one) != now.get(one)]


def damage(folder: Path, *, bags: bool = True) -> list[str]:
    """What is wrong with a store after a failure; a bag that it names must be whole."""
    copy = folder.with_suffix(".copy")
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(folder, copy)  # so that reading recovers nothing that the command has to recover
    if not (copy / "campaign.sqlite").exists():
        return []
    with closing(sqlite3.connect(copy / "campaign.sqlite")) as db:
        problems = [row[0] for row in db.execute("PRAGMA integrity_check") if row[0] != "ok"]
        tables = {name for (name,) in db.execute("SELECT name FROM sqlite_master")}
        names = db.execute("SELECT bag FROM executions").fetchall() if bags and "executions" in tables else []
    return problems + [f"no bag {bag}" for (bag,) in names if not (folder / bag / "metadata.yaml").is_file()]
