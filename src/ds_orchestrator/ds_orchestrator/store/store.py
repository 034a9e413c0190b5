"""The campaign's memory: one SQLite file in which every test and every outcome stands as soon as it is known."""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ds_orchestrator.store.sqlite_file import Row, SqliteFile, StoreError
from ds_road import Road
from ds_sim.simulator import Outcome

__all__ = ["Execution", "Store", "StoreError", "Test"]


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
        present: the text that an earlier version's configuration has now.

    Raises:
        StoreError: the file is of another campaign or version, damaged, or cannot be written.
    """

    def __init__(
        self, path: Path, *, config: str | None = None, present: Callable[[str], str] = lambda known: known
    ) -> None:
        self._file = SqliteFile(path, None if config is None else {"config": config})
        if config is not None and (known := self.config) != config and present(known) == config:
            self._file.ask("UPDATE about SET value=? WHERE key='config'", (config,))
        if config is not None and self.config != config:
            different = _differences(self.config, config)
            self.close()
            raise StoreError(
                f"{path.parent} holds a campaign with another configuration ({different}): restore it, or choose "
                "another --out"
            )

    @property
    def config(self) -> str:
        """The campaign's configuration as JSON text."""
        found = self._file.ask("SELECT value FROM about WHERE key='config'")
        if not found:
            raise self._file.damaged("it has no configuration")
        return str(found[0][0])

    def note(self, key: str, value: str) -> str:
        """Keep a fact about the campaign, such as versions; the one that is known already stays. What is known."""
        self._file.ask("INSERT OR IGNORE INTO about VALUES (?, ?)", (key, value))
        return str(self._file.ask("SELECT value FROM about WHERE key=?", (key,))[0][0])

    def add_seconds(self, stage: str, seconds: float) -> None:
        """Add to the time by the wall clock that a stage has taken so far."""
        self._file.ask(
            "INSERT INTO about VALUES (?, printf('%.1f', ?)) ON CONFLICT(key) DO UPDATE SET "
            "value = printf('%.1f', CAST(value AS REAL) + CAST(excluded.value AS REAL))",
            (f"seconds {stage}", seconds),
        )

    def notes(self) -> dict[str, str]:
        """Every fact about the campaign."""
        return dict(self._file.ask("SELECT key, value FROM about ORDER BY key"))

    def add_test(self, test: Test) -> None:
        """Remember a test; one that is known already stays as it is.

        Raises:
            StoreError: a test of this name is known with another road.
        """
        road = test.road
        row = (
            test.test_id, test.sibling, test.run, test.number, road.road_id, json.dumps(road.control_points),
            road.turns_count, road.curvature_bin, road.curvature, test.seed, road.maxitwo_compatible,
        )  # fmt: skip
        self._file.ask("INSERT OR IGNORE INTO tests VALUES (?,?,?,?,?,?,?,?,?,?,?)", row)
        known = self._file.ask("SELECT road_id FROM tests WHERE test_id=?", (test.test_id,))[0][0]
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
        self._file.ask("INSERT OR REPLACE INTO executions VALUES (?,?,?,?,?,?,?,?,?,?,?,?)", row)

    def add_error(self, test_id: str, simulator: str, attempt: int, outcome: Outcome, message: str) -> None:
        """Remember an attempt that ended in an error."""
        row = (test_id, simulator, attempt, outcome.name, message)
        self._file.ask("INSERT INTO errors VALUES (?,?,?,?,?)", row)

    def take_back(self, test_ids: Sequence[str]) -> None:
        """Forget tests without an outcome, the first of which alone stays, to be tried again."""
        self._file.change(
            *(("DELETE FROM given_up WHERE test_id=?", (test_id,)) for test_id in test_ids),
            *(("DELETE FROM tests WHERE test_id=?", (test_id,)) for test_id in test_ids[1:]),
        )

    def give_up(self, test_id: str) -> None:
        """Remember that the search went on without the outcome of a test."""
        self._file.ask("INSERT OR IGNORE INTO given_up VALUES (?)", (test_id,))

    def given_up(self) -> set[str]:
        """Tests without whose outcome the search went on; they may have one now."""
        return {row[0] for row in self._file.ask("SELECT test_id FROM given_up")}

    def add_search(self, sibling: str, run: int, method: str, seed: int) -> None:
        """Remember how one run of a search was begun."""
        self._file.ask("INSERT OR IGNORE INTO searches VALUES (?,?,?,?)", (sibling, run, method, seed))

    def searches(self) -> list[tuple[str, int, str, int]]:
        """Every run of a search: sibling, run, method, seed."""
        rows = self._file.ask("SELECT sibling, run, method, seed FROM searches ORDER BY sibling, run")
        return [(sibling, run, method, seed) for sibling, run, method, seed in rows]

    def set_result(self, stage: str, executions: int) -> None:
        """Remember that a result was made of so many executions."""
        self._file.ask("INSERT OR REPLACE INTO results VALUES (?,?)", (stage, executions))

    def results(self) -> dict[str, int]:
        """Result -> number of executions of which it was made."""
        return dict(self._file.ask("SELECT stage, executions FROM results"))

    def errors(self) -> list[tuple[str, str, int, str, str]]:
        """Attempts that ended in an error: test, simulator, attempt, outcome, message."""
        columns = "test_id, simulator, attempt, outcome, message"
        rows = self._file.ask(f"SELECT {columns} FROM errors ORDER BY test_id, simulator, attempt")
        return [(test, simulator, attempt, outcome, message) for test, simulator, attempt, outcome, message in rows]

    def tests(self) -> list[Test]:
        """Every test, ordered by sibling, run and number."""
        rows = self._file.ask(
            "SELECT test_id, sibling, run, number, control_points, seed, published FROM tests"
            " ORDER BY sibling, run, number"
        )
        return [
            Test(
                test_id=i,
                sibling=s,
                run=r,
                number=n,
                road=Road(json.loads(points), maxitwo_compatible=bool(maxitwo_compatible)),
                seed=seed,
            )
            for i, s, r, n, points, seed, maxitwo_compatible in rows
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
        return int(self._file.ask("SELECT count(*) FROM executions")[0][0])

    def _executions(self, where: str, values: tuple[str, ...]) -> list[Execution]:
        rows = self._file.ask(
            "SELECT test_id, simulator, outcome, message, fitness, max_lateral_position, steps, simulated_seconds,"
            f" trajectory_sha256, trajectory, bag, steering FROM executions {where} ORDER BY simulator, test_id",
            values,
        )
        return [self._execution_of(row) for row in rows]

    def _execution_of(self, row: Row) -> Execution:
        try:
            return Execution(
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
            )
        except (zlib.error, ValueError, TypeError, KeyError):
            raise self._file.damaged(f"the run of {row[0]} on {row[1]} cannot be read") from None

    def close(self) -> None:
        """Write everything out."""
        self._file.close()


def _differences(known: str, given: str) -> str:
    """Which keys of two configurations differ, and how."""
    old, new = _flat(json.loads(known)), _flat(json.loads(given))
    keys = [key for key in new | old if old.get(key) != new.get(key)]
    return "; ".join(f"{key}: {old.get(key)} there, {new.get(key)} now" for key in keys)


def _flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Keys within keys as `search.runs`."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat
