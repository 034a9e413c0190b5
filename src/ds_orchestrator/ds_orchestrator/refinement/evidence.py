"""What the siblings' own drives say about a cell: on each sibling it fails, is safe, or is not settled yet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import numpy as np
from scipy.special import betainc

from ds_orchestrator.prediction.outcome_table import OutcomeTable
from ds_orchestrator.prediction.verdicts import MOST_NEEDED, TOLERATED_RATE, Verdict, called, verdict_of

Agreement = Literal["all fail", "all safe", "siblings differ", "not settled"]


@dataclass(frozen=True, kw_only=True)
class CellEvidence:
    """Tests of one cell with a verdict, and how many of them failed, on every sibling.

    The failure rate on a sibling has Jeffreys' posterior, Beta(failures + 1/2, others + 1/2): drives of this cell alone
    count, whatever the model of `ds predict` makes of other cells. Mutants of one road count as separate tests.

    Attributes:
        cell: bins.
        tests: per sibling.
        failures: per sibling.
        tolerated: failure rate up to which a cell counts as safe.
    """

    cell: tuple[int, ...]
    tests: tuple[int, ...]
    failures: tuple[int, ...]
    tolerated: float = TOLERATED_RATE

    @property
    def verdicts(self) -> tuple[Verdict, ...]:
        """Per sibling, `fails` or `safe` with an error rate of at most `ERROR_RATE`, or `disputed`."""
        return tuple(self._verdict(n, f) for n, f in zip(self.tests, self.failures, strict=True))

    def _verdict(self, tests: int, failures: int) -> Verdict:
        if not tests:
            return "untested"
        above = 1.0 - float(betainc(failures + 0.5, tests - failures + 0.5, self.tolerated))
        return verdict_of(above)

    @property
    def agreement(self) -> Agreement:
        """`siblings differ` as soon as the cell fails on one sibling and is safe on another."""
        found = set(self.verdicts)
        if {"fails", "safe"} <= found:
            return "siblings differ"
        return "all fail" if found == {"fails"} else "all safe" if found == {"safe"} else "not settled"

    @property
    def settled(self) -> bool:
        """Whether further tests on the siblings are not needed."""
        return self.agreement != "not settled"

    @property
    def tests_needed(self) -> int | None:
        """Tests on every sibling until the cell is settled, if failures keep coming at the rates seen so far.

        0 if it is settled; None if that is more than `ds_orchestrator.prediction.verdicts.MOST_NEEDED`, as a rate is
        too near the tolerated one.
        """
        if self.settled:
            return 0
        needed = [
            _needed(tests, failures, self.tolerated)
            for tests, failures, verdict in zip(self.tests, self.failures, self.verdicts, strict=True)
            if verdict in ("disputed", "untested")
        ]
        return None if None in needed else max(n for n in needed if n is not None)

    def document(self) -> dict[str, Any]:
        """Convert to JSON values."""
        return {
            "tests": list(self.tests), "failures": list(self.failures), "verdicts": list(self.verdicts),
            "agreement": self.agreement, "tests_needed": self.tests_needed,
        }  # fmt: skip


@cache
def _needed(tests: int, failures: int, tolerated: float) -> int | None:
    """Tests until one sibling is settled; one that never drove the cell is taken not to fail there."""
    for further in (np.arange(1, _FEW + 1), np.arange(_FEW + 1, MOST_NEEDED + 1)):
        more = further * (failures / tests if tests else 0.0)
        below = betainc(failures + more + 0.5, tests - failures + further - more + 0.5, tolerated)
        decided = np.flatnonzero(np.logical_or(*called(below)))
        if len(decided):
            return int(further[decided[0]])
    return None


_FEW = 100
"""Tests that are tried first, as most cells need fewer."""


def evidence_of(
    table: OutcomeTable, cells: Sequence[tuple[int, ...]], *, tolerated: float = TOLERATED_RATE
) -> list[CellEvidence]:
    """Count the drives of some cells on every sibling.

    Args:
        table: outcomes.
        cells: cells to count.
        tolerated: failure rate up to which a cell counts as safe.
    """
    place = {cell: k for k, cell in enumerate(cells)}
    tests = [[0] * len(table.siblings) for _ in cells]
    failures = [[0] * len(table.siblings) for _ in cells]
    for s, name in enumerate(table.siblings):
        known, failed = table.known(name), table.failed(name)
        for row, cell in enumerate(table.cells):
            if cell in place and known[row]:
                tests[place[cell]][s] += 1
                failures[place[cell]][s] += bool(failed[row])
    return [
        CellEvidence(cell=cell, tests=tuple(n), failures=tuple(f), tolerated=tolerated)
        for cell, n, f in zip(cells, tests, failures, strict=True)
    ]
