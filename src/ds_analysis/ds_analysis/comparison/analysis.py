"""Compares two networks by their drives on the same tests: per simulator, and per cell of the feature map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from ds_analysis.common.paired_statistics import ALPHA, PairedCounts, adjusted
from ds_analysis.comparison.drives import Network, PairedDrive
from ds_orchestrator.search.features import DEFAULT_FEATURES, Cell

Verdict = Literal["worse", "better", "not significant"]
Origin = Literal["random", "both", "reference", "suite"]
"""How tests were chosen: at random; by a search against each network; by a search against the reference alone; or for
a suite, which was selected by the reference's outcomes."""


@dataclass(frozen=True, kw_only=True)
class SimulatorComparison:
    """Both networks on one simulator.

    Attributes:
        simulator: name of the simulator.
        counts: over all tests.
        p_adjusted: of `counts`, by Holm over every p-value from which verdicts are made.
        unsearched: over the tests that no network's outcome led to.
        unsearched_p_adjusted: of `unsearched`, likewise.
        verdict: `worse` by all tests, `better` by tests that do not favour the candidate.
        margin_change: median change of the smallest lateral distance, m; negative is worse. None without tests.
    """

    simulator: str
    counts: PairedCounts
    p_adjusted: float
    unsearched: PairedCounts
    unsearched_p_adjusted: float
    verdict: Verdict
    margin_change: float | None


@dataclass(frozen=True, kw_only=True)
class CellComparison:
    """Both networks in one cell of the feature map on one simulator.

    Attributes:
        simulator: name of the simulator.
        cell: bins of the features.
        counts: over the cell's tests.
        p_adjusted: by Benjamini and Hochberg over all filled cells of all simulators.
    """

    simulator: str
    cell: Cell
    counts: PairedCounts
    p_adjusted: float


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Two networks on the same tests.

    Attributes:
        reference: the network that is known.
        candidate: the network that may replace it.
        origin: how the tests were chosen.
        source: where they come from, in words.
        features: axes of the cells.
        twin: simulator that acts as the twin, or None.
        drives: every pair with a verdict of both, the worst change first.
        simulators: one comparison for each simulator.
        cells: one comparison for each filled cell of each simulator.
        excluded: pairs by which no network can be judged.
        left_out: pairs in which a drive ended in an error: test, simulator and reason.
    """

    reference: Network
    candidate: Network
    origin: Origin
    source: str
    features: tuple[str, ...]
    twin: str | None
    drives: Sequence[PairedDrive]
    simulators: Sequence[SimulatorComparison]
    cells: Sequence[CellComparison]
    excluded: int = 0
    left_out: Sequence[tuple[str, str, str]] = ()

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
    def tests(self) -> int:
        """Number of different tests."""
        return len({drive.test.name for drive in self.drives})

    def tally(self) -> dict[str, tuple[int, int]]:
        """Simulator -> failures of the candidate, and its drives."""
        return {one.simulator: (one.counts.candidate_failures, one.counts.tests) for one in self.simulators}


def compare_networks(
    drives: Sequence[PairedDrive],
    *,
    reference: Network,
    candidate: Network,
    origin: Origin,
    source: str,
    simulators: Sequence[str],
    features: Sequence[str] = DEFAULT_FEATURES,
    twin: str | None = None,
    excluded: int = 0,
    left_out: Sequence[tuple[str, str, str]] = (),
) -> Comparison:
    """Compare two networks by their drives on the same tests.

    Tests that a search found against the reference favour the candidate: where the reference was made to fail, a
    network that is as good fails less often. There, `better` is judged by the unsearched tests alone.

    Args:
        drives: every test on every simulator, with a verdict of both networks.
        reference: the network that is known.
        candidate: the network that may replace it.
        origin: how the tests were chosen.
        source: where they come from, in words.
        simulators: names of the simulators, in the order of the rows.
        features: axes of the cells.
        twin: simulator that acts as the twin, or None.
        excluded: number of pairs by which no network can be judged.
        left_out: pairs in which a drive ended in an error.
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
        simulators=_simulators(of, is_fair=origin in ("random", "both")),
        cells=_cells(of),
        excluded=excluded,
        left_out=tuple(left_out),
    )


def _simulators(of: Mapping[str, Sequence[PairedDrive]], *, is_fair: bool) -> list[SimulatorComparison]:
    every = {name: PairedCounts.of(drives) for name, drives in of.items()}
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
        rows.append(
            SimulatorComparison(
                simulator=name,
                counts=every[name],
                p_adjusted=of_all,
                unsearched=unsearched[name],
                unsearched_p_adjusted=of_unsearched,
                verdict=verdict,
                margin_change=float(np.median([d.margin_change for d in drives])) if drives else None,
            )
        )
    return rows


def _cells(of: Mapping[str, Sequence[PairedDrive]]) -> list[CellComparison]:
    groups: dict[tuple[str, Cell], list[PairedDrive]] = {}
    for name, drives in of.items():
        for drive in drives:
            if drive.test.cell is not None:
                groups.setdefault((name, drive.test.cell), []).append(drive)
    order = {name: place for place, name in enumerate(of)}
    keys = sorted(groups, key=lambda key: (order[key[0]], key[1]))
    counts = {key: PairedCounts.of(groups[key]) for key in keys}
    p = adjusted([one.p for one in counts.values()], "fdr_bh")
    return [
        CellComparison(simulator=name, cell=cell, counts=one, p_adjusted=value)
        for ((name, cell), one), value in zip(counts.items(), p, strict=True)
    ]


def _worst_first(drives: Sequence[PairedDrive]) -> list[PairedDrive]:
    """Sort by change, by the number of simulators on which the test newly fails, then by the lost distance."""
    order = {"newly fails": 0, "fails in both": 1, "passes in both": 2, "fixed": 3}
    spread: dict[str, int] = {}
    for drive in drives:
        spread[drive.test.name] = spread.get(drive.test.name, 0) + (drive.change == "newly fails")
    return sorted(
        drives,
        key=lambda d: (order[d.change], -spread[d.test.name], d.margin_change, d.test.name, d.simulator),
    )
