# SPDX-License-Identifier: Apache-2.0
"""Cuts the power of a small campaign: builds what a disk may hold then, and lets the same command go on there.

A file system may keep or lose, in any order, what was written to a file since that file was last synchronised, and
names since their folder, or the file that has them, was. A process of its own, into which `disk.c` is preloaded.

The database is checked in every state. The command goes on once from all states that have the same files and, after
SQLite's recovery, the same rows: it sees no more of a database.
"""

from __future__ import annotations

import hashlib
import shutil
import sqlite3
import struct
import sys
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tests.campaign.disk import Disk, damage, differences
from tests.campaign.failing_disk import ds, prepare

WRITE, SYNC, RENAME, OPEN, MKDIR, TRUNCATE, UNLINK, RMDIR = range(8)
"""As the enumeration in `disk.c`."""
HEADER = struct.Struct("5l")
MIXED = 8
"""States after each cut in which each call that may be lost is, or is not, by chance."""
DATA, NAMES = {WRITE, TRUNCATE}, {RENAME, OPEN, MKDIR, UNLINK, RMDIR}


@dataclass
class Call:
    """A call that reached the disk: its paths relative to the folder, and the file or folder that it concerns."""

    kind: int
    path: str
    to: str
    at: int
    data: bytes
    file: int = -1


Tree = dict[str, bytearray | None]
"""Path -> content, or None for a folder."""


def calls_of(record: bytes, folder: Path) -> list[Call]:
    """Read a record, and number the files and folders in it."""
    calls, at, names, numbers = [], 0, {"": 0}, iter(range(1, 10**9))
    while at < len(record):
        kind, *lengths, place, size = HEADER.unpack_from(record, at)
        at += HEADER.size
        parts = []
        for length in (*lengths, size):
            parts.append(record[at : at + length])
            at += length
        path, to = (str(Path(part.decode()).relative_to(folder)) if part else "" for part in parts[:2])
        call = Call(kind, "" if path == "." else path, to, place, parts[2])
        if kind in (OPEN, MKDIR):
            call.file = names[call.path] if call.path in names else names.setdefault(call.path, next(numbers))
        elif kind == RENAME:
            call.file = names[path]
            moved = {name: number for name, number in names.items() if name == path or name.startswith(f"{path}/")}
            names = {name: number for name, number in names.items() if name not in moved and name != to}
            names |= {to + name[len(path) :]: number for name, number in moved.items()}
        elif kind in (UNLINK, RMDIR):
            call.file = names.pop(call.path)
        elif call.path in names:
            call.file = names[call.path]
        else:
            continue  # a file that has no name any more
        calls.append(call)
    return calls


def parent(path: str) -> str:
    """Folder of a path; "" for the campaign's own."""
    return path.rpartition("/")[0]


def unsure(calls: Sequence[Call]) -> list[int]:
    """Numbers of the calls that a power cut after the last one may undo."""
    synced: set[int] = set()
    folders: set[str] = set()
    lost = []
    for number in range(len(calls) - 1, -1, -1):
        call = calls[number]
        if call.kind == SYNC:
            synced.add(call.file)
            folders |= {call.path, ""}
            above = parent(call.path)
            while above:  # a file that is synchronised is found under its name
                folders.add(f"{above}/.")
                above = parent(above)
        elif call.kind in DATA or (call.kind == OPEN and call.at):
            if call.file not in synced:
                lost.append(number)
        elif call.kind == MKDIR and (call.file in synced or f"{call.path}/." in folders):
            continue
        elif call.file not in synced and parent(call.to or call.path) not in folders:
            lost.append(number)
    return lost


def replayed(calls: Sequence[Call], lost: set[int], halved: int = -1) -> Tree:
    """What a disk holds that lost some of the calls, and half of one write."""
    files: dict[int, bytearray | None] = {0: None}
    names: dict[str, int] = {"": 0}
    for number, call in enumerate(calls):
        if call.kind in DATA and number not in lost:
            content = files.setdefault(call.file, bytearray())
            assert content is not None
            if call.kind == TRUNCATE:
                del content[call.at :]
                content.extend(bytes(call.at - len(content)))
            else:
                data = call.data[: len(call.data) // 2] if number == halved else call.data
                content.extend(bytes(max(0, call.at - len(content))))
                content[call.at : call.at + len(data)] = data
        elif number in lost:
            continue
        elif call.kind == MKDIR:
            files[call.file], names[call.path] = None, call.file
        elif call.kind == OPEN:
            names[call.path] = call.file
            if call.at:
                files[call.file] = bytearray()
            files.setdefault(call.file, bytearray())
        elif call.kind == RENAME:
            inside = [name for name in names if name == call.path or name.startswith(f"{call.path}/")]
            moved = {call.to + name[len(call.path) :]: names.pop(name) for name in inside}
            names |= moved
        elif call.kind in (UNLINK, RMDIR):
            names.pop(call.path, None)
    tree: Tree = {}
    for name in sorted(names):
        above = parent(name)
        if name and (not above or (above in tree and tree[above] is None)):
            tree[name] = files.get(names[name], bytearray())
    return tree


def states(calls: Sequence[Call], rng: np.random.Generator) -> Iterator[tuple[str, Tree]]:
    """Yield what a disk may hold after a power cut right after the last call, each with its description."""
    lost = unsure(calls)
    data = {number for number in lost if calls[number].kind in DATA or calls[number].kind == OPEN and calls[number].at}
    names = set(lost) - data
    yield "kept all", replayed(calls, set())
    yield "lost all", replayed(calls, set(lost))
    yield "lost all content", replayed(calls, data)
    yield "lost all names", replayed(calls, names)
    for _ in range(MIXED):
        some = {number for number in lost if rng.random() < 0.5}
        yield f"lost {sorted(some)}", replayed(calls, some)
    for number in lost[:20]:
        call = calls[number]
        what = f"{('write', 'sync', 'rename', 'open', 'mkdir', 'truncate', 'unlink', 'rmdir')[call.kind]} {call.path}"
        yield f"lost only {what}", replayed(calls, {number})
        yield f"kept only {what}", replayed(calls, set(lost) - {number})
        if call.kind == WRITE:
            yield f"kept half of {what}", replayed(calls, set(), number)


def build(tree: Tree, folder: Path) -> None:
    """Write a state into an empty folder."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    for name, content in tree.items():
        if content is None:
            (folder / name).mkdir()
        elif not name.endswith("-shm"):  # memory, which no power cut keeps
            (folder / name).write_bytes(content)


def digest_of(tree: Tree) -> str:
    """Digest of a state, without memory."""
    digest = hashlib.sha256()
    for name, content in sorted(tree.items()):
        if not name.endswith("-shm"):
            digest.update(f"{name} {'folder' if content is None else len(content)}\n".encode())
            digest.update(content or b"")
    return digest.hexdigest()


def seen_in(tree: Tree, recovered: Path) -> str:
    """Digest of what a command sees of a state, given a copy in which SQLite has recovered the database."""
    rest = {name: content for name, content in tree.items() if not name.startswith("campaign.sqlite-")}
    if (path := recovered / "campaign.sqlite").is_file():
        with closing(sqlite3.connect(path)) as db:
            settings = (db.execute(f"PRAGMA {one}").fetchall() for one in ("journal_mode", "user_version", "page_size"))
            rest["campaign.sqlite"] = bytearray("\n".join([*map(repr, settings), *db.iterdump()]).encode())
    return digest_of(rest)


def problems_of(tree: Tree, folder: Path, whole: Path, resumed: set[str]) -> list[str]:
    """Let a campaign go on in a state unless it has from its like; returns what is not as an undisturbed one has it."""
    build(tree, folder)
    problems = damage(folder, bags=False)
    seen = seen_in(tree, folder.with_suffix(".copy"))
    if seen in resumed:
        return problems
    resumed.add(seen)
    status, said = ds(folder)
    problems += [f"status {status} {said}"] if status else []
    return problems or differences(folder, whole)


def main(scratch: Path, first: int, step: int) -> None:
    """Cut the power after every so many calls, and print one line for each state from which the command fails."""
    prepare(scratch)
    disk, whole = Disk(scratch), scratch / "whole"
    whole.mkdir()
    record = disk.record(whole)
    status, said = ds(whole)
    disk.disarm()
    calls = calls_of(record.read_bytes(), whole)
    if status:
        sys.exit(f"undisturbed: {status} {said}")
    build(replayed(calls, set()), scratch / "again")
    if wrong := differences(scratch / "again", whole):
        sys.exit(f"the record is not whole: {wrong}")
    tried: set[str] = set()
    resumed: set[str] = set()
    for cut in range(first, len(calls) + 1, step):
        for description, tree in states(calls[:cut], np.random.default_rng(cut)):
            digest = digest_of(tree)
            if digest in tried:
                continue
            tried.add(digest)
            if problems := problems_of(tree, scratch / "tried", whole, resumed):
                print(f"after {cut}, {description}: {problems}", flush=True)
    print(f"tried {len(tried)} states of {len(calls)} calls, of which a command sees {len(resumed)}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
