# SPDX-License-Identifier: Apache-2.0
"""Stores every test and every outcome of a campaign as soon as it is known, in one SQLite file."""

from __future__ import annotations

import re
import warnings
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from ds_base.bounded_file import load_json
from ds_base.folder_files import StoreError
from ds_base.intervals import FailureCount
from ds_orchestrator.store import rows
from ds_orchestrator.store.model import Execution, Test, execution_of, row_of, test_of
from ds_orchestrator.store.sqlite_file import SqliteFile
from ds_sim.gates.gate import Gate, GateState
from ds_sim.registry import SimulatorName
from ds_sim.simulator import Outcome

_SECONDS = "seconds "


class Store:
    """Reads and writes the file of one campaign; may be used from several threads.

    Every row is checked when it is read: types, ranges, known outcomes, finite numbers, and each trajectory, once it
    is asked for, against its SHA-256. An invalid row raises `StoreError` with a message of one line.

    Args:
        path: of the file, created if missing and `config` is given.
        config: configuration of the campaign as JSON text, written once and compared afterwards; None to open an
            existing campaign.
        read_only: change nothing, even while a campaign writes the file.

    Raises:
        StoreError: the file belongs to another campaign or version, is damaged, or cannot be written.
    """

    def __init__(self, path: Path, *, config: str | None = None, read_only: bool = False) -> None:
        self._file = SqliteFile(path, None if config is None else {"config": config}, read_only=read_only)
        if config is not None and self.config != config:
            try:
                different = _differences(self.config, config)
            except (ValueError, AttributeError):
                different = "the stored text is not a configuration"
            self.close()
            raise StoreError(
                f"{path.parent} holds a campaign with another configuration ({different}): restore it, or choose "
                "another --out"
            )

    @property
    def config(self) -> str:
        """The campaign's configuration as JSON text."""
        facts = self._rows(rows.FactRow, "about WHERE key='config'")
        if not facts:
            raise self._file.damaged("it has no configuration")
        return facts[0].value

    def note(self, key: str, value: str) -> str:
        """Store a fact about the campaign, such as a version, unless it is known; returns the stored value."""
        self._file.ask("INSERT OR IGNORE INTO about VALUES (?, ?)", (key, value))
        return str(self._file.ask("SELECT value FROM about WHERE key=?", (key,))[0][0])

    def add_seconds(self, stage: str, seconds: float) -> None:
        """Add to the wall-clock time of a stage."""
        self._file.ask(
            "INSERT INTO about VALUES (?, printf('%.1f', ?)) ON CONFLICT(key) DO UPDATE SET "
            "value = printf('%.1f', CAST(value AS REAL) + CAST(excluded.value AS REAL))",
            (f"{_SECONDS}{stage}", seconds),
        )

    def notes(self) -> dict[str, str]:
        """Every fact about the campaign."""
        facts = dict(self._rows(rows.FactRow, "about ORDER BY key"))
        for key, value in facts.items():
            if key.startswith(_SECONDS) and not re.fullmatch(r"[0-9]{1,15}(\.[0-9]+)?", value):
                raise self._file.damaged(f"{key!r:.60} is {value!r:.60}, expected seconds")
        return facts

    def add_test(self, test: Test) -> None:
        """Store a test unless it is known.

        Raises:
            StoreError: a test with this id is known with another road or other conditions.
        """
        row = row_of(test)
        self._insert("INSERT OR IGNORE INTO tests", row)
        stored = self._file.ask("SELECT road_id, conditions FROM tests WHERE test_id=?", (test.test_id,))[0]
        if stored != (row.road_id, row.conditions):
            what = "another road" if stored[0] != row.road_id else "other conditions"
            raise StoreError(
                f"test {test.test_id} has {what} than when this campaign started: resume with the version of ds that "
                "started it, or choose another --out"
            )

    def add_gate(self, test_id: str, simulator: SimulatorName, gate: Gate) -> None:
        """Store what the gates say of a test on one simulator; only a valid test can become an excluded one."""
        outcome = "" if gate.outcome is None else gate.outcome.name
        row = rows.GateRow(
            test_id, simulator, gate.state.value, gate.message, outcome, gate.visible_contrast, gate.hidden_share
        )
        self._file.ask(
            "INSERT INTO gates VALUES (?,?,?,?,?,?,?) ON CONFLICT(test_id, simulator) DO UPDATE SET "
            f"state = excluded.state, message = excluded.message WHERE state = '{GateState.VALID}'",
            row,
        )

    def gate(self, test_id: str, simulator: SimulatorName) -> Gate | None:
        """What the gates say of a test on one simulator, or None if that is not known."""
        return self._gates("WHERE test_id=? AND simulator=?", (test_id, simulator)).get((test_id, simulator))

    def gates(self) -> dict[tuple[str, SimulatorName], Gate]:
        """What the gates say of every test and simulator for which that is known, ordered by simulator and test."""
        return self._gates()

    def _gates(self, where: str = "", values: tuple[str, ...] = ()) -> dict[tuple[str, SimulatorName], Gate]:
        return {
            (row.test_id, row.simulator): Gate(
                state=GateState(row.state),
                message=row.message,
                outcome=Outcome[row.outcome] if row.outcome else None,
                visible_contrast=row.visible_contrast,
                hidden_share=row.hidden_share,
            )
            for row in self._rows(rows.GateRow, f"gates {where} ORDER BY simulator, test_id", values)
        }

    def add_execution(self, execution: Execution) -> None:
        """Store an execution; call it after its bag is written, so that a stored execution is complete."""
        values = {name: getattr(execution, name) for name in rows.ExecutionRow._fields[:-1]}
        frames = rows.pack_numbers(execution.trajectory), rows.pack_numbers(execution.steering)
        self._insert(
            "INSERT OR REPLACE INTO executions", (*(values | {"outcome": execution.outcome.name}).values(), *frames)
        )

    def add_error(self, test_id: str, simulator: SimulatorName, attempt: int, outcome: Outcome, message: str) -> None:
        """Store an attempt that ended in an error."""
        self._insert("INSERT INTO errors", rows.ErrorRow(test_id, simulator, attempt, outcome.name, message))

    def take_back(self, test_ids: Sequence[str]) -> None:
        """Delete tests without an outcome except the first, which is tried again."""
        self._file.change(
            *(("DELETE FROM given_up WHERE test_id=?", (test_id,)) for test_id in test_ids),
            *(
                (f"DELETE FROM {table} WHERE test_id=?", (test_id,))
                for table in ("gates", "tests")
                for test_id in test_ids[1:]
            ),
        )

    def give_up(self, test_id: str) -> None:
        """Store that the search continued without the outcome of a test."""
        self._insert("INSERT OR IGNORE INTO given_up", rows.IdRow(test_id))

    def given_up(self) -> set[str]:
        """Tests whose search continued without their outcome; they may have one by now."""
        return {row.test_id for row in self._rows(rows.IdRow, "given_up")}

    def add_search(self, sibling: SimulatorName, run: int, method: str, seed: int) -> None:
        """Store method and seed of one run of a search."""
        self._insert("INSERT OR IGNORE INTO searches", rows.SearchRow(sibling, run, method, seed))

    def searches(self) -> list[rows.SearchRow]:
        """Every run of a search."""
        return self._rows(rows.SearchRow, "searches ORDER BY sibling, run")

    def set_result(self, stage: str, executions: int) -> None:
        """Store the number of executions from which a result was computed."""
        self._insert("INSERT OR REPLACE INTO results", rows.ResultRow(stage, executions))

    def results(self) -> dict[str, int]:
        """Result -> number of executions from which it was computed."""
        return dict(self._rows(rows.ResultRow, "results"))

    def errors(self) -> list[rows.ErrorRow]:
        """Attempts that ended in an error."""
        return self._rows(rows.ErrorRow, "errors ORDER BY test_id, simulator, attempt")

    def _insert(self, how: str, values: Sequence[object]) -> None:
        self._file.ask(f"{how} VALUES ({','.join('?' * len(values))})", values)

    def _rows(self, kind: type[rows.Record], source: str, values: Sequence[object] = ()) -> list[rows.Record]:
        """Read and check rows of a table, or of a SELECT in brackets."""
        records = self._file.ask(f"SELECT {', '.join(kind._fields)} FROM {source}", values)
        try:
            return rows.check_rows(kind, records)
        except rows.RowError as error:
            raise self._file.damaged(f"{source.split()[0].strip('(')}, {error}") from None

    def tests(self, *, after: int = 0) -> list[Test]:
        """Tests, ordered by sibling, run and number; only those stored after a row, see `last_rows`."""
        records = self._rows(rows.TestRow, "tests WHERE rowid > ? ORDER BY sibling, run, number", (after,))
        try:
            return [test_of(row) for row in records]
        except rows.RowError as error:
            raise self._file.damaged(str(error)) from None

    def check(
        self, siblings: Collection[SimulatorName], simulators: Collection[SimulatorName], *, runs: int, budget: int
    ) -> None:
        """Refuse rows that a campaign over these simulators, with so many runs of so many tests, cannot have.

        StoreError for another simulator, a run or number out of range, an execution without its test or of an excluded
        one, and an impossible value in a smaller table; other columns are checked when they are read.
        """
        for read in (self.notes, self.errors, self.searches, self.results, self.given_up, self.gates):
            read()
        for table, column, names in (
            ("tests", "sibling", siblings),
            ("executions", "simulator", simulators),
            ("gates", "simulator", simulators),
        ):
            for (name,) in self._file.ask(f"SELECT DISTINCT {column} FROM {table}"):
                if name not in names:
                    raise self._file.damaged(f"{table} of {name!r:.60}, a simulator that is not in its configuration")
        if self._file.ask("SELECT 1 FROM tests WHERE run >= ? OR number >= ? LIMIT 1", (runs, budget)):
            raise self._file.damaged("tests with a run or number beyond its configuration")
        for table, what in (("executions", "an execution"), ("gates", "a gate")):
            orphans = f"SELECT test_id FROM {table} WHERE test_id NOT IN (SELECT test_id FROM tests) LIMIT 1"
            if lost := self._file.ask(orphans):
                raise self._file.damaged(f"{what} of {lost[0][0]!r:.60}, a test that does not exist")

        both = self._file.ask(
            "SELECT test_id FROM executions NATURAL JOIN (SELECT test_id, simulator FROM gates WHERE state != ?) "
            "LIMIT 1",
            (GateState.VALID.value,),
        )
        if both:
            raise self._file.damaged(f"an execution of {both[0][0]!r:.60} where its gate excludes it")

    def execution(self, test_id: str, simulator: SimulatorName) -> Execution | None:
        """The execution of a test on one simulator, or None if there is none yet."""
        executions = self._executions("WHERE test_id=? AND simulator=?", (test_id, simulator))
        return executions[0] if executions else None

    def executions(self, *, after: int = 0) -> list[Execution]:
        """Executions, ordered by simulator and test; only those stored after a row, see `last_rows`."""
        return self._executions("WHERE rowid > ?", (after,)) if after else self._executions("", ())

    def sampled_executions(self, most: int) -> list[Execution]:
        """At most so many executions, spread evenly over the order in which they were stored."""
        return self._executions("WHERE rowid % ? = 0", (max(-(-self.last_rows()[1] // most), 1),))

    def last_rows(self) -> tuple[int, int]:
        """Numbers of the last rows of tests and of executions; an execution that replaces another one has a new row."""
        last = "SELECT coalesce(max(rowid), 0) FROM"
        return int(self._file.ask(f"{last} tests")[0][0]), int(self._file.ask(f"{last} executions")[0][0])

    def test_of_row(self, row: int) -> str | None:
        """Id of the test in a row, or None if there is none; tests that are taken back leave their rows to others."""
        records = self._file.ask("SELECT test_id FROM tests WHERE rowid=?", (row,))
        return str(records[0][0]) if records else None

    def latest_executions(self) -> dict[SimulatorName, str]:
        """Simulator -> test whose execution there was stored last."""
        records = self._file.ask("SELECT simulator, test_id, max(rowid) FROM executions GROUP BY simulator")
        return {SimulatorName(simulator): str(test_id) for simulator, test_id, _ in records}

    def count_tests(self) -> int:
        """Number of tests."""
        return int(self._file.ask("SELECT count(*) FROM tests")[0][0])

    def count_executions(self) -> int:
        """Number of executions."""
        return int(self._file.ask("SELECT count(*) FROM executions")[0][0])

    def drive_counts(self) -> list[rows.DriveCount]:
        """Numbers of executions by search of their tests, simulator and outcome, in the order of `executions`."""
        return self._rows(
            rows.DriveCount,
            "(SELECT sibling, run, simulator, outcome, count(*) AS executions, min(test_id) AS first FROM executions "
            "JOIN tests USING (test_id) GROUP BY sibling, run, simulator, outcome) ORDER BY simulator, first",
        )

    def failures_of_groups(self) -> dict[tuple[SimulatorName, int, SimulatorName], FailureCount]:
        """Deprecated, goes in 0.5: sibling and run of a search, and simulator -> failures of its tests there."""
        warnings.warn("failures_of_groups goes in 0.5: use drive_counts", DeprecationWarning, stacklevel=2)
        counts: dict[tuple[SimulatorName, int, SimulatorName], FailureCount] = {}
        for row in self.drive_counts():
            key = row.sibling, row.run, row.simulator
            failures, tests = counts.get(key, (0, 0))
            failures += row.executions * Outcome[row.outcome].is_failure
            counts[key] = FailureCount(failures, tests + row.executions)
        return counts

    def outcome_counts(self) -> Counter[tuple[str, str]]:
        """Deprecated, goes in 0.5: simulator and name of the outcome -> number of executions."""
        warnings.warn("outcome_counts goes in 0.5: use drive_counts", DeprecationWarning, stacklevel=2)
        counts: Counter[tuple[str, str]] = Counter()
        for row in self.drive_counts():
            counts[row.simulator, row.outcome] += row.executions
        return counts

    def count_excluded(self) -> Counter[tuple[SimulatorName, int, SimulatorName]]:
        """Number of tests that the gates exclude, by sibling and run of their search, and simulator."""
        records = self._file.ask(
            "SELECT sibling, run, simulator, count(*) FROM gates JOIN tests USING (test_id) WHERE state != ? "
            "GROUP BY sibling, run, simulator",
            (GateState.VALID.value,),
        )
        return Counter(
            {(SimulatorName(sibling), run, SimulatorName(simulator)): n for sibling, run, simulator, n in records}
        )

    def count_tests_by_sibling(self) -> Counter[SimulatorName]:
        """Sibling -> number of tests that its searches generated."""
        records = self._file.ask("SELECT sibling, count(*) FROM tests GROUP BY sibling")
        return Counter({SimulatorName(sibling): count for sibling, count in records})

    def bags(self) -> list[str]:
        """Bags of all executions, in their order."""
        return [row.bag for row in self._rows(rows.BagRow, "executions WHERE bag != '' ORDER BY simulator, test_id")]

    def count_results(self) -> int:
        """Number of executions and gates, from which maps, evaluation and report are made."""
        return self.count_executions() + int(self._file.ask("SELECT count(*) FROM gates")[0][0])

    def _executions(self, where: str, values: tuple[str | int, ...]) -> list[Execution]:
        records = self._rows(rows.ExecutionRow, f"executions {where} ORDER BY simulator, test_id", values)
        try:
            return [execution_of(row, self._file) for row in records]
        except rows.RowError as error:
            raise self._file.damaged(str(error)) from None

    def close(self) -> None:
        """Close the file; everything is written."""
        self._file.close()


def seconds_of(notes: Mapping[str, str]) -> dict[str, float]:
    """Read stage -> seconds from a store's notes; longest first."""
    seconds = {key.removeprefix(_SECONDS): float(value) for key, value in notes.items() if key.startswith(_SECONDS)}
    return dict(sorted(seconds.items(), key=lambda item: -item[1]))


def _differences(stored: str, asked: str) -> str:
    """Describe the keys in which two configurations, as JSON text, differ, with both values."""
    old, new = _flat(load_json(stored)), _flat(load_json(asked))
    unset = "the default"
    keys = [key for key in new | old if old.get(key) != new.get(key)]
    return "; ".join(f"{key}: {old.get(key, unset)} there, {new.get(key, unset)} now" for key in keys)


def _flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten nested keys, as in `search.runs`."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat
