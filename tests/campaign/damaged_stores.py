# SPDX-License-Identifier: Apache-2.0
"""Stores of campaigns as strangers and earlier versions write them."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from ds_orchestrator.store.store import Store


@contextmanager
def lax_tables(path: Path) -> Iterator[None]:
    """Let a store's tables hold values of any type; they look as before at the end."""

    def write(tables: Iterable[tuple[str, str]]) -> None:
        with closing(sqlite3.connect(path, isolation_level=None)) as db:
            db.execute("PRAGMA writable_schema=ON")
            db.executemany("UPDATE sqlite_master SET sql = ?2 WHERE name = ?1 AND type = 'table'", tables)

    with closing(sqlite3.connect(path)) as db:
        strict = db.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table'").fetchall()
    write((name, sql.removesuffix(" STRICT")) for name, sql in strict)
    yield
    write(strict)


def change_store(path: Path, statement: str, *values: object) -> None:
    """Run a statement on a store as somebody does who keeps to none of its rules."""
    with lax_tables(path), closing(sqlite3.connect(path, isolation_level=None)) as db:
        db.execute("PRAGMA ignore_check_constraints=ON")
        db.execute(statement, values)


_SCHEMA_4 = """
CREATE TABLE about (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE tests (
    test_id TEXT PRIMARY KEY, sibling TEXT NOT NULL, run INTEGER NOT NULL, number INTEGER NOT NULL,
    road_id TEXT NOT NULL, control_points TEXT NOT NULL, turns_count INTEGER NOT NULL, curvature_bin INTEGER NOT NULL,
    curvature REAL NOT NULL, seed INTEGER NOT NULL, maxitwo_compatible INTEGER NOT NULL,
    conditions TEXT NOT NULL);
CREATE TABLE executions (
    test_id TEXT NOT NULL REFERENCES tests, simulator TEXT NOT NULL, outcome TEXT NOT NULL, message TEXT NOT NULL,
    fitness REAL NOT NULL, max_lateral_position REAL NOT NULL, steps INTEGER NOT NULL,
    simulated_seconds REAL NOT NULL, trajectory_sha256 TEXT NOT NULL, trajectory BLOB NOT NULL, steering BLOB NOT NULL,
    bag TEXT NOT NULL,
    PRIMARY KEY (test_id, simulator));
CREATE TABLE errors (
    test_id TEXT NOT NULL, simulator TEXT NOT NULL, attempt INTEGER NOT NULL, outcome TEXT NOT NULL,
    message TEXT NOT NULL);
CREATE TABLE given_up (test_id TEXT PRIMARY KEY);
CREATE TABLE searches (
    sibling TEXT NOT NULL, run INTEGER NOT NULL, method TEXT NOT NULL, seed INTEGER NOT NULL,
    PRIMARY KEY (sibling, run));
CREATE TABLE results (stage TEXT PRIMARY KEY, executions INTEGER NOT NULL);
CREATE TABLE gates (
    test_id TEXT NOT NULL REFERENCES tests, simulator TEXT NOT NULL, state TEXT NOT NULL, message TEXT NOT NULL,
    outcome TEXT NOT NULL, visible_contrast REAL NOT NULL, hidden_share REAL NOT NULL,
    PRIMARY KEY (test_id, simulator));
"""


def write_as_version_4(path: Path, old: Path) -> None:
    """Write the content of a store into a new file as version 0.2.0 of this project wrote it."""
    with closing(Store(path, read_only=True)) as store:
        tests = store.tests()
    with closing(sqlite3.connect(old, isolation_level=None)) as db:
        db.executescript(_SCHEMA_4)
        db.execute("ATTACH ? AS new", (str(path),))
        for table in ("about", "errors", "given_up", "searches", "results", "gates"):
            db.execute(f"INSERT INTO main.{table} SELECT * FROM new.{table}")
        for test in tests:
            points = json.dumps(test.road.control_points)
            db.execute(
                "INSERT INTO main.tests SELECT test_id, sibling, run, number, road_id, ?, turns_count, 0, curvature, "
                "seed, ?, conditions FROM new.tests WHERE test_id = ?",
                (points, test.road.maxitwo_compatible, test.test_id),
            )
        columns = "test_id, simulator, outcome, message, fitness, max_lateral_position, steps, simulated_seconds"
        db.execute(
            f"INSERT INTO main.executions SELECT {columns}, trajectory_sha256, trajectory, steering, bag "
            "FROM new.executions"
        )
        db.execute("DETACH new")
        db.execute("PRAGMA user_version=4")
