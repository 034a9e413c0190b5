# SPDX-License-Identifier: Apache-2.0
"""Compares two networks by their drives on the same tests, and says whether the candidate should replace the other."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from ds_analysis.common.selection import ALPHA
from ds_analysis.comparison.paired_drives import TOLERANCE, Network, PairedCounts, PairedDrive, adjusted, fewest_changes
from ds_base.table import p_in_words
from ds_base.words import count
from ds_orchestrator.search.features import DEFAULT_AXES, Cell, Feature
from ds_sim.registry import SimulatorName

Verdict = Literal["worse", "better", "not significant"]
Origin = Literal["random", "both", "reference", "suite"]
"""How tests were chosen: at random; by a search against both, or the reference alone; for a suite, by its outcomes."""


@dataclass(frozen=True, kw_only=True)
class SimulatorComparison:
    """Both networks on one simulator.

    Attributes:
        p_adjusted: of `counts`, by Holm over every p-value from which verdicts are made.
        unsearched: over the tests that no network's outcome led to.
        unsearched_p_adjusted: of `unsearched`, likewise.
        verdict: of other tests: `worse` by all of these, `better` by those that do not favour the candidate.
        margin_change: median change of the smallest lateral distance, m; negative is worse. None if no test has one.
    """

    simulator: SimulatorName
    counts: PairedCounts
    p_adjusted: float
    unsearched: PairedCounts
    unsearched_p_adjusted: float
    verdict: Verdict
    margin_change: float | None


@dataclass(frozen=True, kw_only=True)
class CellComparison:
    """Both networks in one cell on one simulator; p is adjusted by Benjamini and Hochberg over all filled cells."""

    simulator: SimulatorName
    cell: Cell
    counts: PairedCounts
    p_adjusted: float


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Two networks on the same tests.

    Attributes:
        candidate: the network that may replace the reference.
        source: where the tests come from, in words.
        drives: every pair with a verdict of both, the worst change first.
        cells: one comparison for each filled cell of each simulator.
        excluded: pairs by which no network can be judged.
        left_out: pairs in which a drive ended in an error: test, simulator and reason.
    """

    reference: Network
    candidate: Network
    origin: Origin
    source: str
    features: tuple[Feature, ...]
    twin: SimulatorName | None
    drives: Sequence[PairedDrive]
    simulators: Sequence[SimulatorComparison]
    cells: Sequence[CellComparison]
    excluded: int = 0
    left_out: Sequence[tuple[str, SimulatorName, str]] = ()

    @cached_property
    def newly_failing(self) -> list[PairedDrive]:
        """Pairs that got worse from pass to failure, worst first."""
        return [drive for drive in self.drives if drive.change == "newly fails"]

    @cached_property
    def fixed(self) -> list[PairedDrive]:
        """Pairs that got better from failure to pass."""
        return [drive for drive in self.drives if drive.change == "fixed"]

    @property
    def is_identical(self) -> bool:
        """Whether every drive of both networks is the same, to the bit."""
        pairs = [(one.reference.trajectory_sha256, one.candidate.trajectory_sha256) for one in self.drives]
        return bool(pairs) and all(first == second != "" for first, second in pairs)

    @property
    def is_sequential(self) -> bool:
        """Whether outcomes decided when the drives ended."""
        return any(row.counts.changes is not None for row in self.simulators)

    @property
    def tests(self) -> int:
        """Number of different tests."""
        return len({drive.test.name for drive in self.drives})

    def tally(self) -> dict[SimulatorName, tuple[int, int]]:
        """Simulator -> failures of the candidate, and its drives."""
        return {one.simulator: (one.counts.candidate_failures, one.counts.tests) for one in self.simulators}


def compare_networks(
    drives: Sequence[PairedDrive],
    *,
    reference: Network,
    candidate: Network,
    origin: Origin,
    source: str,
    simulators: Sequence[SimulatorName],
    features: Sequence[Feature] = DEFAULT_AXES,
    twin: SimulatorName | None = None,
    excluded: int = 0,
    left_out: Sequence[tuple[str, SimulatorName, str]] = (),
    sequential: bool = False,
) -> Comparison:
    """Compare two networks by their drives on the same tests; for the arguments see `Comparison`.

    Tests that a search found against the reference favour the candidate, so `better` is judged by the unsearched ones
    alone. With `sequential`, the drives end where their outcomes make the answer sure.
    """
    of = {name: [drive for drive in drives if drive.simulator == name] for name in simulators}
    return Comparison(
        reference=reference,
        candidate=candidate,
        origin=origin,
        source=source,
        features=tuple(features),
        twin=twin,
        drives=_worst_first(drives),
        simulators=_simulators(of, is_fair=origin in ("random", "both"), sequential=sequential),
        cells=_cells(of),
        excluded=excluded,
        left_out=tuple(left_out),
    )


def _simulators(
    of: Mapping[SimulatorName, Sequence[PairedDrive]], *, is_fair: bool, sequential: bool
) -> list[SimulatorComparison]:
    every = {name: PairedCounts.of(drives, sequential=sequential) for name, drives in of.items()}
    unsearched = {name: PairedCounts.of(d for d in drives if d.test.unsearched) for name, drives in of.items()}
    # Without tests there is no comparison, and nothing to correct for.
    family = {(name, "all"): counts.p for name, counts in every.items() if counts.tests}
    if not is_fair:
        family |= {(name, "unsearched"): counts.p for name, counts in unsearched.items() if counts.tests}
    p = dict(zip(family, adjusted(list(family.values()), "holm"), strict=True))
    rows = []
    for name, drives in of.items():
        of_all = p.get((name, "all"), 1.0)
        of_unsearched = of_all if is_fair else p.get((name, "unsearched"), 1.0)
        fair, fair_p = (every[name], of_all) if is_fair else (unsearched[name], of_unsearched)
        verdict: Verdict = "not significant"
        if of_all < ALPHA and every[name].newly_fail > every[name].fixed:
            verdict = "worse"
        elif fair_p < ALPHA and fair.fixed > fair.newly_fail:
            verdict = "better"
        changes = [one.margin_change for one in drives if None not in (one.reference.fitness, one.candidate.fitness)]
        rows.append(
            SimulatorComparison(
                simulator=name,
                counts=every[name],
                p_adjusted=of_all,
                unsearched=unsearched[name],
                unsearched_p_adjusted=of_unsearched,
                verdict=verdict,
                margin_change=float(np.median(changes)) if changes else None,
            )
        )
    return rows


def _cells(of: Mapping[SimulatorName, Sequence[PairedDrive]]) -> list[CellComparison]:
    there: dict[tuple[SimulatorName, Cell], list[PairedDrive]] = defaultdict(list)
    for name, drives in of.items():
        for drive in drives:
            if drive.test.cell is not None:
                there[name, drive.test.cell].append(drive)
    order = list(of)
    counts = {key: PairedCounts.of(there[key]) for key in sorted(there, key=lambda key: (order.index(key[0]), key[1]))}
    p = adjusted([one.p for one in counts.values()], "fdr_bh")
    return [
        CellComparison(simulator=name, cell=cell, counts=one, p_adjusted=value)
        for ((name, cell), one), value in zip(counts.items(), p, strict=True)
    ]


def _worst_first(drives: Sequence[PairedDrive]) -> list[PairedDrive]:
    """Sort by change, by the number of simulators on which the test newly fails, then by the lost distance."""
    order = {"newly fails": 0, "fails in both": 1, "passes in both": 2, "fixed": 3}
    spread = Counter(drive.test.name for drive in drives if drive.change == "newly fails")
    return sorted(
        drives, key=lambda d: (order[d.change], -spread[d.test.name], d.margin_change, d.test.name, d.simulator)
    )


def is_sure(comparison: Comparison) -> bool:
    """Whether further random tests would hardly change the answer: it is worse somewhere, or nowhere by `TOLERANCE`."""
    if any(row.verdict == "worse" for row in comparison.simulators):
        return True
    ends = [row.counts.interval for row in comparison.simulators]
    return all(end is not None and end[1] < TOLERANCE for end in ends)


Advice = Literal["merge", "look first", "do not merge", "not decided"]


def advice_of(comparison: Comparison) -> Advice:
    """Advise by rules that were fixed before any comparison.

    - `do not merge`: the candidate is significantly worse on some simulator.
    - `look first`: some test newly fails.
    - `not decided`: drives are missing, or the reference passes so few tests on some simulator that a candidate which
      failed all of them could not be called worse.
    - `merge`: none of these.
    """
    if any(row.verdict == "worse" for row in comparison.simulators):
        return "do not merge"
    if comparison.newly_failing:
        return "look first"
    needed = fewest_changes(family_of(comparison), sequential=comparison.is_sequential)
    passed = [row.counts.newly_fail + row.counts.both_pass for row in comparison.simulators]
    too_few = not comparison.is_identical and any(number < needed for number in passed)
    return "not decided" if comparison.left_out or too_few else "merge"


def answer_of(comparison: Comparison) -> str:
    """Answer the question whether to merge, in one sentence."""
    advice, newly = advice_of(comparison), len(comparison.newly_failing)
    if advice == "do not merge":
        return "Merge? No: it is worse."
    if advice == "look first":
        fails = f"Merge? Look first: {count(newly, 'drive')} newly {'fails' if newly == 1 else 'fail'}"
        return fails + ("." if comparison.fixed else ", none is fixed: on these tests it is worse.")
    if advice == "not decided":
        missing = "drives are missing" if comparison.left_out else "too few tests to tell, though none newly fails"
        return f"Merge? Not decided: {missing}."
    if comparison.is_identical:
        return "Merge? Nothing changes: every drive is the same."
    worst = max(row.counts.interval[1] for row in comparison.simulators if row.counts.interval)
    if worst < 0 and all(row.verdict == "better" for row in comparison.simulators):
        fewer = math.floor(-100 * worst)
        return f"Merge? Yes: no drive newly fails, and in 100 such tests at least {fewer} fewer fail on each simulator."
    return (
        "Merge? Nothing speaks against it: no drive newly fails; "
        f"at most {max(0, math.ceil(100 * worst))} more failures in 100 such tests are compatible with that."
    )


def family_of(comparison: Comparison) -> int:
    """Number of p-values from which verdicts are made."""
    families = [row.counts for row in comparison.simulators]
    if comparison.origin in ("reference", "suite"):
        families += [row.unsearched for row in comparison.simulators]
    return sum(counts.tests > 0 for counts in families)


def sentences_of(comparison: Comparison) -> list[str]:
    """Give the reasons, the most important first."""
    if not comparison.drives:
        return ["No test has a verdict of both networks, so nothing was compared."]
    if comparison.is_identical:
        return [
            f"Both networks drove all {count(len(comparison.drives), 'pair')} identically, to the bit."
            + (" They are the same files." if comparison.reference.sha256 == comparison.candidate.sha256 else "")
        ]
    order = {"worse": 0, "better": 1, "not significant": 2}
    rows = sorted(comparison.simulators, key=lambda row: order[row.verdict])
    sentences = [_sentence(row, comparison) for row in rows if row.counts.tests]
    if comparison.left_out:
        sentences.append(f"{count(len(comparison.left_out), 'pair')} left out: a drive ended in an error.")
    return sentences


def cautions_of(comparison: Comparison) -> list[str]:
    """Say what the numbers cannot carry."""
    if comparison.is_identical:
        return []
    cautions = []
    if comparison.origin == "suite":
        cautions = ["The tests of a suite were selected and are no sample: what counts are tests that newly fail."]
    elif comparison.origin == "reference":
        random = max((row.unsearched.tests for row in comparison.simulators), default=0)
        judged = f"is judged by the {count(random, 'random road')} among them"
        cautions.append(
            f"The tests were searched for failures of {comparison.reference.driver}; a network that is as good fails "
            "on fewer of them. So tests that newly fail are real, but fixed ones are no evidence that the candidate is "
            f'better: "better" {judged if random else "is not claimed, as none is random"}.'
        )
    if comparison.origin != "random":
        cautions.append(
            "Tests of a search resemble each other: p counts mutants of one road together, intervals are too narrow."
        )
    family = family_of(comparison)
    needed = fewest_changes(family, sequential=comparison.is_sequential)
    changed = max((row.counts.newly_fail + row.counts.fixed for row in comparison.simulators), default=0)
    if changed < needed:
        cautions.append(
            f"Too few tests change for a conclusion about other roads: {changed} at most on one simulator; with "
            f"{count(family, 'comparison')}, a significant difference needs {needed} in the same direction, none a "
            "mutant of another."
        )
    return cautions


def _sentence(row: SimulatorComparison, comparison: Comparison) -> str:
    """Say what happened on these tests, which is certain as drives repeat to the bit; then what that says of others."""
    where = f"{row.simulator} (twin)" if row.simulator == comparison.twin else row.simulator
    said = f"{where}: {_changes(row.counts, 'test')}."
    if row.verdict == "worse":
        return f"{said} Other such roads: worse, too ({p_in_words(row.p_adjusted)} after Holm)."
    if row.verdict == "better":
        random = "" if comparison.origin in ("random", "both") else f"{_changes(row.unsearched, 'random road')}; "
        return f"{said} Other such roads: better, too ({random}{p_in_words(row.unsearched_p_adjusted)} after Holm)."
    assert row.counts.interval is not None
    low, high = (f"{abs(100 * end):.0f} {'more' if end > 0 else 'fewer'}" for end in row.counts.interval)
    sentence = f"Whether that holds for other such roads: {p_in_words(row.p_adjusted)} after Holm, so it is open"
    if row.counts.newly_fail == row.counts.fixed:
        sentence = "Other such roads: no difference is shown"
    return f"{said} {sentence}; 95%: {low} to {high} failures in 100."


def _changes(counts: PairedCounts, what: str) -> str:
    tests, newly, fixed = count(counts.tests, what), counts.newly_fail, counts.fixed
    if not newly and not fixed:
        return f"the same {'outcome' if counts.tests == 1 else 'outcomes'} on {tests}"
    if newly >= fixed:
        change = f"{newly} of {tests} passed and now {'fails' if newly == 1 else 'fail'}, {fixed or 'none'}"
    else:
        change = f"{fixed} of {tests} failed and now {'passes' if fixed == 1 else 'pass'}, {newly or 'none'}"
    verdict = "worse" if newly > fixed else "better" if newly < fixed else "neither better nor worse"
    return f"{change} the other way: on these it is {verdict}"
