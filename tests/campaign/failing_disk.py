# SPDX-License-Identifier: Apache-2.0
"""Runs a small campaign on a disk that fails; a process of its own, into which `failing_disk.c` is preloaded.

Every repetition is a fork, so that libraries are loaded once. Drives are real ones, in this process; the pictures of
the report, which are written by the same function as the other files, are left out as they would take the time.
"""

from __future__ import annotations

import ctypes
import errno
import os
import shutil
import sqlite3
import sys
import traceback
from contextlib import closing, nullcontext, suppress
from pathlib import Path
from typing import Any

from tests.campaign.engines import EngineHere

from ds_base.atomic_files import write_whole
from ds_cli import application
from ds_orchestrator.engines.start import ENGINES
from ds_report import heatmap, html_report

KINDS = ("write", "sync", "rename", "open", "mkdir")
"""As the enumeration in `failing_disk.c`."""
ERRORS = {"full": errno.ENOSPC, "broken": errno.EIO, "short": 0}


def ds(folder: Path, disk: Any, kind: int, nth: int, error: str, *, stays: bool) -> tuple[int, str, list[int]]:
    """Give the command once, in a fork; returns its status, its standard error and the number of calls of each kind."""
    reading, writing = os.pipe()
    if (child := os.fork()) == 0:
        status = 255
        with suppress(BaseException):
            said = os.open(folder.with_suffix(".err"), os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
            os.dup2(said, 2)
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            disk.disk_fails(os.fsencode(folder), kind, nth, ERRORS[error], stays)
            try:
                status = application.run(
                    ["campaign", "run", f"{folder.parent}/c.yaml", "--engine", "local", "--out", str(folder)]
                )
            except BaseException:
                traceback.print_exc()
            sys.stderr.flush()
            os.write(writing, b" ".join(b"%d" % disk.disk_calls(one) for one in range(len(KINDS))))
        os._exit(status)
    os.close(writing)
    with os.fdopen(reading) as counts:
        calls = [int(one) for one in counts.read().split()]
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return status, folder.with_suffix(".err").read_text(), calls


def content(folder: Path) -> dict[str, bytes | list[Any]]:
    """Every result in a folder, hidden files included; of the store, and the log that it may keep, the rows."""
    files: dict[str, bytes | list[Any]] = {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.name.startswith("campaign.sqlite")
    }
    with closing(sqlite3.connect(folder / "campaign.sqlite")) as db:
        for table in ("tests", "executions", "errors", "given_up", "searches", "results", "gates"):
            files[table] = sorted(db.execute(f"SELECT * FROM {table}"), key=repr)
    return files


def damage(folder: Path) -> list[str]:
    """What is wrong with a store after a failure; a bag that it names must be whole."""
    copy = folder.with_suffix(".copy")
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(folder, copy)  # so that reading recovers nothing that the command has to recover
    if not (copy / "campaign.sqlite").exists():
        return []
    with closing(sqlite3.connect(copy / "campaign.sqlite")) as db:
        problems = [row[0] for row in db.execute("PRAGMA integrity_check") if row[0] != "ok"]
        tables = {name for (name,) in db.execute("SELECT name FROM sqlite_master")}
        bags = db.execute("SELECT bag FROM executions").fetchall() if "executions" in tables else []
    return problems + [f"no bag {bag}" for (bag,) in bags if not (folder / bag / "metadata.yaml").is_file()]


def problems_at(folder: Path, disk: Any, whole: Path, failure: tuple[int, int, str, bool]) -> list[str]:
    """Let one call fail and give the command again; returns what is not as an undisturbed campaign has it."""
    kind, nth, error, stays = failure
    shutil.rmtree(folder, ignore_errors=True)
    status, said, _ = ds(folder, disk, kind, nth, error, stays=stays)
    problems = [] if status in (0, 1, 2) else [f"status {status}"]
    problems += [said] if "Traceback" in said or "bug of ds" in said else []
    if status:
        problems += [said] if said.count("error: ") != 1 else []
        problems += damage(folder) if folder.is_dir() else []
        problems += [f"left {one}" for one in folder.rglob("*.partial*")]
        status, said, _ = ds(folder, disk, 0, 0, "full", stays=False)
        problems += [f"resumed: {status} {said}"] if status else []
    now, expected = content(folder), content(whole)
    return problems + [f"differs: {one}" for one in expected.keys() | now if expected.get(one) != now.get(one)]


def main(folder: Path, library: str, error: str, stays: bool, first: int, step: int) -> None:
    """Let each call fail, and print one line for each failure after which something is wrong."""
    disk = ctypes.CDLL(library)
    ENGINES["local"] = lambda *_: nullcontext(EngineHere())
    heatmap.write_maps = lambda *_: None
    html_report.write_report = lambda out, *_, **__: write_whole(out / "report.html", "")  # type: ignore[assignment]
    whole = folder / "whole"
    status, said, calls = ds(whole, disk, 0, 0, "full", stays=False)
    if status:
        sys.exit(f"undisturbed: {status} {said}")
    tried = 0
    for kind, name in enumerate(KINDS if error != "short" else KINDS[:1]):
        for nth in range(first, calls[kind] + 1, step):
            tried += 1
            if problems := problems_at(folder / "tried", disk, whole, (kind, nth, error, stays)):
                print(f"{name} {nth}: {problems}", flush=True)
    print(f"tried {tried} of", " ".join(f"{name}={count}" for name, count in zip(KINDS, calls, strict=True)))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], sys.argv[3], sys.argv[4] == "stays", int(sys.argv[5]), int(sys.argv[6]))
