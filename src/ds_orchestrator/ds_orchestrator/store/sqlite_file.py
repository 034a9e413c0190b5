# SPDX-License-Identifier: Apache-2.0
"""SQLite file of a campaign: never changes a file of another kind, and reports every failure in one line."""

from __future__ import annotations

import hashlib
import os
import sqlite3
import stat
import threading
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from ds_base.bounded_file import open_regular
from ds_base.folder_files import StoreError

SCHEMA_VERSION = 5
SCHEMA = """
CREATE TABLE about (key TEXT PRIMARY KEY, value TEXT NOT NULL) STRICT;
CREATE TABLE tests (
    test_id TEXT PRIMARY KEY, sibling TEXT NOT NULL, run INTEGER NOT NULL CHECK (run >= 0),
    number INTEGER NOT NULL CHECK (number >= 0), road TEXT NOT NULL, road_id TEXT NOT NULL,
    turns_count INTEGER NOT NULL, curvature REAL NOT NULL, seed INTEGER NOT NULL CHECK (seed >= 0),
    conditions TEXT NOT NULL) STRICT;
CREATE TABLE executions (
    test_id TEXT NOT NULL REFERENCES tests, simulator TEXT NOT NULL, outcome TEXT NOT NULL, message TEXT NOT NULL,
    fitness REAL NOT NULL, max_lateral_position REAL NOT NULL, steps INTEGER NOT NULL CHECK (steps >= 0),
    simulated_seconds REAL NOT NULL, trajectory_sha256 TEXT NOT NULL CHECK (length(trajectory_sha256) = 64),
    bag TEXT NOT NULL, trajectory BLOB NOT NULL, steering BLOB NOT NULL,
    PRIMARY KEY (test_id, simulator)) STRICT;
CREATE TABLE errors (
    test_id TEXT NOT NULL, simulator TEXT NOT NULL, attempt INTEGER NOT NULL, outcome TEXT NOT NULL,
    message TEXT NOT NULL) STRICT;
CREATE TABLE given_up (test_id TEXT PRIMARY KEY) STRICT;
CREATE TABLE searches (
    sibling TEXT NOT NULL, run INTEGER NOT NULL, method TEXT NOT NULL, seed INTEGER NOT NULL,
    PRIMARY KEY (sibling, run)) STRICT;
CREATE TABLE results (stage TEXT PRIMARY KEY, executions INTEGER NOT NULL) STRICT;
CREATE TABLE gates (
    test_id TEXT NOT NULL REFERENCES tests, simulator TEXT NOT NULL, state TEXT NOT NULL, message TEXT NOT NULL,
    outcome TEXT NOT NULL, visible_contrast REAL NOT NULL, hidden_share REAL NOT NULL,
    PRIMARY KEY (test_id, simulator)) STRICT;
"""
_OLD_VERSION = 4
_OLD_TABLES = "9b6805715490a19c6694f51bf88ca296416fada1ca03c21b204b6caae79b763a"
"""Digest of the tables of `_OLD_VERSION`, as `_digest` computes it."""
_OLD_TESTS = """
test_id, sibling, run, number, '{"control_points": ' || control_points
    || ', "maxitwo_compatible": ' || iif(maxitwo_compatible, 'true', 'false') || ', "lane": "'
    || (SELECT iif(json_valid(value), coalesce(value ->> 'lane', 'right'), 'right') FROM about WHERE key = 'config')
    || '"}' AS road, road_id, turns_count, curvature, seed, conditions FROM main.
"""
"""Columns of `tests` in a file of `_OLD_VERSION`, which kept no road whole, as a part of a SELECT."""
LARGEST_FILE = 64 * 2**30
"""Bytes; chosen: three million executions of the usual length."""
LARGEST_VALUE = 64 * 2**20
"""Bytes of one value or row; chosen: a run of `rows.MOST_STEPS` frames fits."""
_DAMAGED = ("SQLITE_CORRUPT", "SQLITE_NOTADB", "SQLITE_TOOBIG", "SQLITE_CONSTRAINT")
_JOURNAL_MAGIC = bytes.fromhex("d9d505f920a163d7")
"""Ends a rollback journal that names a super-journal, which SQLite would delete (SQLite file format, 3)."""
_OLDEST_SQLITE = (3, 38)
"""For STRICT tables, and `->>`."""
_SETTINGS = ("trusted_schema=OFF", "cell_size_check=ON", "mmap_size=0", "synchronous=NORMAL", "temp_store=MEMORY")
Row = tuple[Any, ...]


class SqliteFile:
    """Runs statements on one file, from any thread; a file that is not a campaign's stays unchanged.

    The file may be received from a third party: its tables must be exactly those of `SCHEMA`, so that no view, trigger
    or virtual table takes part in a statement, and the sizes of the file and of every value are bounded.

    Given facts to `begin` with, a new campaign is created if there is none. With `read_only`, file and write-ahead log
    keep their bytes, and all that is read is of one moment, even while another process writes. StoreError if there is
    no campaign, or it has another version, is damaged, or cannot be written.
    """

    def __init__(self, path: Path, begin: Mapping[str, str] | None = None, *, read_only: bool = False) -> None:
        self.path = path
        self._writes = begin is not None
        self._lock = threading.Lock()
        self._closed = False
        self._again: SqliteFile | None = None
        folder = path.parent
        if sqlite3.sqlite_version_info < _OLDEST_SQLITE:
            raise StoreError(
                f"SQLite {sqlite3.sqlite_version} cannot hold campaigns, expected {'.'.join(map(str, _OLDEST_SQLITE))} "
                "or later: use a newer Python"
            )
        if begin is None and not path.exists():
            raise StoreError(f"no campaign in {folder}: run one there first")
        self._check_file()
        if not read_only and not all(os.access(one, os.W_OK) for one in (folder, path) if one.exists()):
            raise StoreError(f"{folder} cannot be written: check its permissions, or choose another --out")
        flags = _read_only_flags(path) if read_only else ""
        self._unchanged = _state_of(path) if "immutable" in flags else None
        self._db = self._connect(flags)
        try:
            # With a write-ahead log, NORMAL keeps what is committed when the process is killed. A power cut may cost
            # the last runs, as it may cost their bags: they are driven again. FULL would wait for the disk after each.
            for setting in _SETTINGS:
                self.ask(f"PRAGMA {setting}")
            tables, version = self._tables(), self.ask("PRAGMA user_version")[0][0]
            if not tables and version == 0:  # new, or its process was killed before it created the tables
                if begin is None:
                    raise StoreError(f"no campaign in {folder}: it was stopped before it started, run it again")
                self._begin(begin)
            elif version == _OLD_VERSION and _digest(tables) == _OLD_TABLES:
                if read_only:
                    self.ask(f"CREATE TEMP VIEW tests AS SELECT rowid, {_OLD_TESTS}tests")
                else:
                    self._migrate()
            elif version == 0 or (version == SCHEMA_VERSION and tables != set(_statements())):
                raise StoreError(f"{path} is not a campaign's store: choose another --out")
            elif version != SCHEMA_VERSION:
                raise StoreError(
                    f"{path} was written by another version of ds (schema {version}, expected {SCHEMA_VERSION}): "
                    "use that version, or choose another --out"
                )
            elif begin is not None:
                pages = self.ask("PRAGMA quick_check(1)")[0][0]  # before anything is written
                if pages != "ok":
                    raise self._refusal(sqlite3.DatabaseError(pages))
            if begin is not None:  # also an old one: a copy by VACUUM INTO has no log, and could not be read meanwhile
                self.ask("PRAGMA journal_mode=WAL")
            if read_only:
                self.ask("BEGIN")  # whatever is read from now on is of one moment
        except BaseException:
            self._db.close()
            raise

    def _check_file(self) -> None:
        """Refuse files that SQLite must not open."""
        path = self.path
        for one in (path, *(path.with_name(f"{path.name}{ending}") for ending in ("-journal", "-wal", "-shm"))):
            try:
                status = one.lstat()  # SQLite follows a link, and takes the journals that lie there
            except FileNotFoundError:
                continue
            if one is path and stat.S_ISDIR(status.st_mode):
                raise StoreError(f"{path} is a folder, expected a campaign's store: choose another --out")
            if not stat.S_ISREG(status.st_mode):
                kind = "a link" if stat.S_ISLNK(status.st_mode) else "not a regular file"
                raise StoreError(
                    f"{one} is {kind}, expected a campaign's store: remove it, and copy the campaign again"
                )
            if status.st_size > LARGEST_FILE:
                raise StoreError(f"{one} has more than {LARGEST_FILE // 2**30} GiB, the limit for a campaign")
        journal = path.with_name(f"{path.name}-journal")
        if journal.exists():
            with open_regular(journal, follow_links=False) as file:
                file.seek(max(0, journal.stat().st_size - len(_JOURNAL_MAGIC)))
                if file.read() == _JOURNAL_MAGIC:
                    raise StoreError(f"{journal} refers to other files, expected a campaign's own journal: remove it")

    def _tables(self) -> set[str]:
        """Read the SQL of every schema entry that SQLite did not create itself, whitespace normalised."""
        rows = self.ask("SELECT sql FROM sqlite_master WHERE NOT (type = 'index' AND sql IS NULL)")
        return {" ".join(str(sql).split()) for (sql,) in rows}

    def _connect(self, flags: str) -> sqlite3.Connection:
        name = quote(os.fsencode(self.path.absolute()))
        try:
            connection = sqlite3.connect(f"file:{name}{flags}", uri=True, check_same_thread=False, isolation_level=None)
        except sqlite3.Error as error:
            raise self._refusal(error) from None
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LARGEST_VALUE)
        return connection

    def _begin(self, facts: Mapping[str, str]) -> None:
        """Write tables, version and facts, all or nothing."""
        tables = [(statement, ()) for statement in _statements()]
        about = [("INSERT INTO about VALUES (?, ?)", fact) for fact in facts.items()]
        self.change(*tables, (f"PRAGMA user_version={SCHEMA_VERSION}", ()), *about)

    def _migrate(self) -> None:
        """Copy a file of `_OLD_VERSION` into the present tables, all or nothing."""
        names = [statement.split()[2] for statement in _statements()]
        columns = {name: ", ".join(row[1] for row in self.ask(f"PRAGMA table_info({name})")) for name in names}
        copies = [f"INSERT INTO {name} ({columns[name]}) SELECT * FROM old_{name}" for name in names if name != "tests"]
        statements = [
            *(f"ALTER TABLE {name} RENAME TO old_{name}" for name in names),
            *_statements(),
            *copies,
            f"INSERT INTO tests SELECT {_OLD_TESTS}old_tests",
            *(f"DROP TABLE old_{name}" for name in reversed(names)),
            f"PRAGMA user_version={SCHEMA_VERSION}",
        ]
        self.change(*((statement, ()) for statement in statements))

    def ask(self, statement: str, values: Sequence[object] = ()) -> list[Row]:
        """Run one statement, which may write, and return its rows."""
        with self._lock:
            try:
                return self._db.execute(statement, values).fetchall()
            except (sqlite3.Error, UnicodeDecodeError) as error:  # of a damaged file, even the message may be no text
                raise self._refusal(error) from None
            finally:
                if self._unchanged is not None and _state_of(self.path) != self._unchanged:
                    raise StoreError(f"a campaign writes {self.path} at this moment: wait for it, and try again")

    def read(self, statement: str, values: Sequence[object] = ()) -> list[Row]:
        """Run a SELECT, even after `close`: the file is then opened once more, read-only."""
        if not self._closed:
            return self.ask(statement, values)
        if self._again is None:
            self._again = SqliteFile(self.path, read_only=True)
        return self._again.ask(statement, values)

    def change(self, *statements: tuple[str, Sequence[object]]) -> None:
        """Run several statements, all or nothing."""
        with self._lock:
            try:
                self._db.execute("BEGIN IMMEDIATE")
                for statement, values in statements:
                    self._db.execute(statement, values)
                self._db.execute("COMMIT")
            except sqlite3.Error as error:
                if self._db.in_transaction:
                    self._db.execute("ROLLBACK")
                raise self._refusal(error) from None

    def damaged(self, what: str) -> StoreError:
        """Create the error for content that no campaign writes."""
        return StoreError(f"{self.path} is damaged ({what}): restore it from a copy, or choose another --out")

    def _refusal(self, error: sqlite3.Error | UnicodeDecodeError) -> StoreError:
        name = getattr(error, "sqlite_errorname", "SQLITE_CORRUPT")
        if name.startswith("SQLITE_FULL"):
            return StoreError(f"{self.path} cannot grow, the disk is full: make room, and give the same command again")
        text = "".join(c if c.isprintable() else "?" for c in " ".join(str(error).split()))[:200]
        if name.startswith(_DAMAGED) or "decode" in text:
            return self.damaged(text)
        if name.startswith("SQLITE_BUSY"):
            return StoreError(f"{self.path} is locked by another process: end it, and give the same command again")
        if name.startswith(("SQLITE_CANTOPEN", "SQLITE_READONLY")) and not os.access(self.path.parent, os.W_OK):
            return StoreError(
                f"{self.path.parent} cannot be written, but its campaign was killed: copy the folder first"
            )
        return StoreError(
            f"{self.path} cannot be used ({text}): check the disk and the folder, or choose another --out"
        )

    def close(self) -> None:
        """Close the file; a campaign's log is emptied, unless it is read for too long at this moment.

        Raises:
            StoreError: the disk does not take what was written; the file and its log are sound.
        """
        try:
            if self._writes and not self._closed:
                self.ask("PRAGMA wal_checkpoint(TRUNCATE)")
        finally:
            self._closed = True
            self._db.close()


def _statements() -> list[str]:
    """Statements that create the tables, in order, whitespace normalised."""
    return [" ".join(statement.split()) for statement in SCHEMA.split(";") if statement.strip()]


def _digest(tables: Iterable[str]) -> str:
    return hashlib.sha256("\n".join(sorted(tables)).encode()).hexdigest()


def _state_of(path: Path) -> tuple[int, ...]:
    """What changes when a file is written."""
    status = path.stat()
    return status.st_ino, status.st_size, status.st_mtime_ns


def _read_only_flags(path: Path) -> str:
    """Flags with which SQLite writes neither the file nor its log; without a log, it creates none beside it either."""
    journal = path.with_name(f"{path.name}-wal")
    return "?mode=ro" if journal.exists() and journal.stat().st_size else "?mode=ro&immutable=1"
