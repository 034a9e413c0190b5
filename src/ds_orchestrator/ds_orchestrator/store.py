"""The campaign's memory: one SQLite file in which every test and every outcome stands as soon as it is known."""

from __future__ import annotations

import json
import sqlite3
import threading
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ds_road import Road
from ds_sim.simulator import Outcome

SCHEMA_VERSION = 2
_SCHEMA = """
CREATE TABLE about (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE tests (
    test_id TEXT PRIMARY KEY, sibling TEXT NOT NULL, run INTEGER NOT NULL, number INTEGER NOT NULL,
    road_id TEXT NOT NULL, control_points TEXT NOT NULL, turns_count INTEGER NOT NULL, curvature_bin INTEGER NOT NULL,
    curvature REAL NOT NULL, seed INTEGER NOT NULL, published INTEGER NOT NULL);
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
"""


class StoreError(ValueError):
    """A campaign folder that cannot be used."""


@dataclass(frozen=True, kw_only=True)
class Test:
    """A road that the search made on one sibling.

    Attributes:
        test_id: `<sibling>-<run>-<number>`.
        sibling: name of the sibling whose search made it.
        run: which run of the search, from 0.
        number: which test of the run, from 0.
        road: to drive.
        seed: of every execution of this test.
    """

    __test__ = False  # not a test case for pytest

    test_id: str
    sibling: str
    run: int
    number: int
    road: Road
    seed: int


@dataclass(frozen=True, kw_only=True)
class Execution:
    """What happened when one simulator ran one test.

    Attributes:
        trajectory: (steps + 1, 5) float64: x, y, yaw, speed, lateral position; m, rad, m/s.
        bag: folder of the bag relative to the campaign's, or "".
        steering: (steps,) float64, the commands in [-1, 1].
    """

    test_id: str
    simulator: str
    outcome: Outcome
    message: str
    fitness: float
    max_lateral_position: float
    steps: int
    simulated_seconds: float
    trajectory_sha256: str
    trajectory: NDArray[np.float64]
    bag: str = ""
    steering: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))


class Store:
    """Reads and writes one campaign's file; may be used from several threads.

    Args:
        path: of the file; it is made if it does not exist.
        config: the campaign's configuration as JSON text, written once and compared afterwards.

    Raises:
        StoreError: the file is of another campaign or version, damaged, or cannot be written.
    """

    def __init__(self, path: Path, *, config: str | None = None) -> None:
        self._lock = threading.Lock()
        try:
            if config is None and not path.exists():
                raise StoreError(f"no campaign in {path.parent}: run one there first")
            self._db = sqlite3.connect(path, check_same_thread=False, isolation_level=None)
            self._db.execute("PRAGMA journal_mode=WAL")
            if self._is_empty():
                if config is None:
                    raise StoreError(f"no campaign in {path.parent}: it was stopped before it began, run it again")
                self._begin(config)
            version = self._db.execute("PRAGMA user_version").fetchone()[0]
        except sqlite3.Error as error:
            raise StoreError(f"{path} cannot be used ({error}): check the folder, or choose another --out") from None
        if version != SCHEMA_VERSION:
            raise StoreError(f"{path} has version {version}, expected {SCHEMA_VERSION}: choose another --out folder")
        if config is not None and self.config != config:
            raise StoreError(f"{path.parent} holds a campaign with another configuration: choose another --out")

    def _is_empty(self) -> bool:
        """Whether the file was made just now, or by a process that was killed before it made the tables."""
        return bool(self._db.execute("SELECT count(*) FROM sqlite_master").fetchone()[0] == 0)

    def _begin(self, config: str) -> None:
        """Tables, version and configuration, all or nothing."""
        self._db.execute("BEGIN IMMEDIATE")
        for statement in filter(str.strip, _SCHEMA.split(";")):
            self._db.execute(statement)
        self._db.execute(f"PRAGMA user_version={SCHEMA_VERSION}")
        self._db.execute("INSERT INTO about VALUES ('config', ?)", (config,))
        self._db.execute("COMMIT")

    @property
    def config(self) -> str:
        """The campaign's configuration as JSON text."""
        return str(self._db.execute("SELECT value FROM about WHERE key='config'").fetchone()[0])

    def note(self, key: str, value: str) -> str:
        """Keep a fact about the campaign, such as versions; the one that is known already stays. What is known."""
        with self._lock:
            self._db.execute("INSERT OR IGNORE INTO about VALUES (?, ?)", (key, value))
            return str(self._db.execute("SELECT value FROM about WHERE key=?", (key,)).fetchone()[0])

    def add_seconds(self, stage: str, seconds: float) -> None:
        """Add to the time by the wall clock that a stage has taken so far."""
        key = f"seconds {stage}"
        with self._lock:
            known = self._db.execute("SELECT value FROM about WHERE key=?", (key,)).fetchone()
            total = seconds + (float(known[0]) if known else 0.0)
            self._db.execute("INSERT OR REPLACE INTO about VALUES (?, ?)", (key, f"{total:.1f}"))

    def notes(self) -> dict[str, str]:
        """Every fact about the campaign."""
        with self._lock:
            return dict(self._db.execute("SELECT key, value FROM about ORDER BY key").fetchall())

    def add_test(self, test: Test) -> None:
        """Remember a test; one that is known already stays as it is.

        Raises:
            StoreError: a test of this name is known with another road.
        """
        road = test.road
        row = (
            test.test_id, test.sibling, test.run, test.number, road.road_id, json.dumps(road.control_points),
            road.turns_count, road.curvature_bin, road.curvature, test.seed, road.published,
        )  # fmt: skip
        with self._lock:
            self._db.execute("INSERT OR IGNORE INTO tests VALUES (?,?,?,?,?,?,?,?,?,?,?)", row)
            known = self._db.execute("SELECT road_id FROM tests WHERE test_id=?", (test.test_id,)).fetchone()[0]
        if known != road.road_id:
            raise StoreError(
                f"test {test.test_id} is now another road than when this campaign began: go on with the version that "
                "began it, or choose another --out"
            )

    def add_execution(self, execution: Execution) -> None:
        """Remember what happened; the last thing that is done for an execution, so what stands here is whole."""
        row = (
            execution.test_id, execution.simulator, execution.outcome.name, execution.message, execution.fitness,
            execution.max_lateral_position, execution.steps, execution.simulated_seconds,
            execution.trajectory_sha256, zlib.compress(execution.trajectory.tobytes()),
            zlib.compress(execution.steering.tobytes()), execution.bag,
        )  # fmt: skip
        with self._lock:
            self._db.execute("INSERT OR REPLACE INTO executions VALUES (?,?,?,?,?,?,?,?,?,?,?,?)", row)

    def add_error(self, test_id: str, simulator: str, attempt: int, outcome: Outcome, message: str) -> None:
        """Remember an attempt that ended in an error."""
        with self._lock:
            row = (test_id, simulator, attempt, outcome.name, message)
            self._db.execute("INSERT INTO errors VALUES (?,?,?,?,?)", row)

    def take_back(self, test_ids: Sequence[str]) -> None:
        """Forget tests without an outcome, the first of which alone stays, to be tried again."""
        with self._lock:
            self._db.execute("BEGIN IMMEDIATE")
            for test_id in test_ids:
                self._db.execute("DELETE FROM given_up WHERE test_id=?", (test_id,))
            for test_id in test_ids[1:]:
                self._db.execute("DELETE FROM tests WHERE test_id=?", (test_id,))
            self._db.execute("COMMIT")

    def give_up(self, test_id: str) -> None:
        """Remember that the search went on without the outcome of a test."""
        with self._lock:
            self._db.execute("INSERT OR IGNORE INTO given_up VALUES (?)", (test_id,))

    def given_up(self) -> set[str]:
        """Tests without whose outcome the search went on; they may have one now."""
        with self._lock:
            return {row[0] for row in self._db.execute("SELECT test_id FROM given_up")}

    def add_search(self, sibling: str, run: int, method: str, seed: int) -> None:
        """Remember how one run of a search was begun."""
        with self._lock:
            self._db.execute("INSERT OR IGNORE INTO searches VALUES (?,?,?,?)", (sibling, run, method, seed))

    def searches(self) -> list[tuple[str, int, str, int]]:
        """Every run of a search: sibling, run, method, seed."""
        with self._lock:
            return self._db.execute("SELECT * FROM searches ORDER BY sibling, run").fetchall()

    def set_result(self, stage: str, executions: int) -> None:
        """Remember that a result was made of so many executions."""
        with self._lock:
            self._db.execute("INSERT OR REPLACE INTO results VALUES (?,?)", (stage, executions))

    def results(self) -> dict[str, int]:
        """Result -> number of executions of which it was made."""
        with self._lock:
            return dict(self._db.execute("SELECT stage, executions FROM results").fetchall())

    def errors(self) -> list[tuple[str, str, int, str, str]]:
        """Attempts that ended in an error: test, simulator, attempt, outcome, message."""
        with self._lock:
            return self._db.execute("SELECT * FROM errors ORDER BY test_id, simulator, attempt").fetchall()

    def tests(self) -> list[Test]:
        """Every test, ordered by sibling, run and number."""
        with self._lock:
            rows = self._db.execute(
                "SELECT test_id, sibling, run, number, control_points, seed, published FROM tests"
                " ORDER BY sibling, run, number"
            ).fetchall()
        return [
            Test(
                test_id=i,
                sibling=s,
                run=r,
                number=n,
                road=Road(json.loads(points), published=bool(published)),
                seed=seed,
            )
            for i, s, r, n, points, seed, published in rows
        ]

    def execution(self, test_id: str, simulator: str) -> Execution | None:
        """What happened on one simulator, or None if it did not happen yet."""
        found = self._executions("WHERE test_id=? AND simulator=?", (test_id, simulator))
        return found[0] if found else None

    def executions(self) -> list[Execution]:
        """Every execution, ordered by simulator and test."""
        return self._executions("", ())

    def count_executions(self) -> int:
        """Number of executions."""
        with self._lock:
            return int(self._db.execute("SELECT count(*) FROM executions").fetchone()[0])

    def _executions(self, where: str, values: tuple[str, ...]) -> list[Execution]:
        with self._lock:
            rows = self._db.execute(
                "SELECT test_id, simulator, outcome, message, fitness, max_lateral_position, steps, simulated_seconds,"
                f" trajectory_sha256, trajectory, bag, steering FROM executions {where} ORDER BY simulator, test_id",
                values,
            ).fetchall()
        return [
            Execution(
                test_id=row[0],
                simulator=row[1],
                outcome=Outcome[row[2]],
                message=row[3],
                fitness=row[4],
                max_lateral_position=row[5],
                steps=row[6],
                simulated_seconds=row[7],
                trajectory_sha256=row[8],
                trajectory=np.frombuffer(zlib.decompress(row[9])).reshape(-1, 5),
                bag=row[10],
                steering=np.frombuffer(zlib.decompress(row[11])),
            )  # fmt: skip
            for row in rows
        ]

    def close(self) -> None:
        """Write everything out."""
        self._db.close()
