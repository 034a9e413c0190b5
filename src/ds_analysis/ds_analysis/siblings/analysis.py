# SPDX-License-Identifier: Apache-2.0
"""How differently simulators behave on the same roads (paper 3.2), and all that says about what a sibling adds."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ds_analysis.common.cross_validation import REPEATS
from ds_analysis.common.driven_road import DrivenRoad
from ds_analysis.common.outcome_table import RoadTable
from ds_analysis.common.statistics import Array, r_or_nan
from ds_analysis.failure_patterns import KINDS, Departures, Nesting, departures_of, nestings
from ds_analysis.siblings.beyond_features import (
    AddedInformation,
    Baseline,
    ResidualCorrelation,
    baseline_of,
    information_about,
    residual_correlations,
)
from ds_base.table import Column, Table, styled
from ds_base.words import listed
from ds_sim.registry import SimulatorName
from ds_sim.simulator import Outcome

APART = 0.5
"""Distance from which two lateral positions count as apart, m; chosen: a quarter of half a lane."""


@dataclass(frozen=True)
class PairComparison:
    """Comparison of two simulators on the same roads.

    Attributes:
        roads: number of roads on which both runs ended with a verdict.
        kappa: Cohen's kappa of the verdicts; None if undefined, by `reason`.
        kappa_interval: asymptotic 95% interval of kappa (statsmodels), clipped to [-1, 1].
        median_apart: median distance of the lateral positions over all places, m; then 95th percentile, and largest.
        share_apart: share of places at which they are more than `APART` apart.
        correlation: Pearson r of the lateral positions over all places; None if one is constant.
    """

    first: str
    second: str
    roads: int
    both_fail: int
    only_first_fails: int
    only_second_fails: int
    both_complete: int
    kappa: float | None
    kappa_interval: tuple[float, float] | None
    reason: str
    median_apart: float | None
    apart_95: float | None
    most_apart: float | None
    share_apart: float | None
    correlation: float | None


def compare(table: RoadTable) -> list[PairComparison]:
    """Compare every pair of simulators, in their order, on the tests with a verdict on both."""
    return [_pair(table, a, b) for a, b in combinations(table.simulators, 2)]


def summary(runs: Sequence[DrivenRoad]) -> dict[str, Any]:
    """Summarise outcomes and driving quality of one simulator, as JSON values."""
    judged = [run for run in runs if run.outcome.is_verdict]
    failures = sum(run.outcome.is_failure for run in judged)
    return {
        "roads": len(judged),
        "errors": len(runs) - len(judged),
        "failures": failures,
        "success_rate": (len(judged) - failures) / len(judged) if judged else None,
        "outcomes": {o.name: n for o in Outcome if (n := sum(run.outcome is o for run in runs))},
        "median_max_lateral_position": float(np.median([r.max_lateral_position for r in judged])) if judged else None,
    }


def most_different(table: RoadTable, count: int) -> list[int]:
    """Find the rows of the tests on which two simulators get farthest apart, the farthest first."""
    widest = [
        max((float(gap.max()) for a, b in combinations(at, 2) if len(gap := gaps(a, b))), default=0)
        for at in zip(*table.profiles.values(), strict=True)
    ]
    return sorted(range(len(table)), key=lambda i: (-widest[i], i))[:count]


def gaps(one: Array, other: Array) -> Array:
    """Compute the distance between two profiles, m, at the places that both cover."""
    both = min(len(one), len(other))
    return np.abs(one[:both] - other[:both])


def _pair(outcomes: RoadTable, first: SimulatorName, second: SimulatorName) -> PairComparison:
    judged = np.flatnonzero(outcomes.known(first) & outcomes.known(second)).tolist()
    failed, other_failed = outcomes.failed(first)[judged], outcomes.failed(second)[judged]
    table = np.zeros((2, 2), int)
    np.add.at(table, (failed.astype(int), other_failed.astype(int)), 1)
    pairs = [(outcomes.profiles[first][k], outcomes.profiles[second][k]) for k in judged]
    common = [min(map(len, pair)) for pair in pairs]
    ones, others = (
        np.concatenate([np.empty(0), *(pair[i][:both] for pair, both in zip(pairs, common, strict=True))])
        for i in (0, 1)
    )
    none, only_second, only_first, both = table.ravel().tolist()
    kappa, distances = _kappa(first, second, table), _distances(ones, others)
    return PairComparison(first, second, len(judged), both, only_first, only_second, none, *kappa, *distances)


def _distances(ones: Array, others: Array) -> tuple[float | None, ...]:
    """Median, 95th percentile and largest distance of lateral positions, share of those apart, and correlation."""
    if not len(ones):
        return (None,) * 5
    apart, correlation = np.abs(ones - others), r_or_nan(ones, others)
    sizes = np.median(apart), np.percentile(apart, 95), apart.max(), (apart > APART).mean()
    return (*map(float, sizes), None if math.isnan(correlation) else correlation)


def _kappa(
    first: SimulatorName, second: SimulatorName, table: NDArray[np.int_]
) -> tuple[float | None, tuple[float, float] | None, str]:
    """Compute Cohen's kappa of a table of verdicts (rows: first, columns: second) and its interval, or the reason."""
    from statsmodels.stats.inter_rater import cohens_kappa

    if table.sum() == 0:
        return None, None, "no road was driven to a verdict on both"
    for name, counts in ((first, table.sum(axis=1)), (second, table.sum(axis=0))):
        if 0 in counts:
            verdict = "completes" if counts[1] == 0 else "fails"
            return None, None, f"{name} {verdict} every road: agreement beyond chance is not defined"
    agreement = cohens_kappa(table)
    # The asymptotic interval may leave kappa's range.
    interval = max(float(agreement.kappa_low), -1.0), min(float(agreement.kappa_upp), 1.0)
    return float(agreement.kappa), interval if all(map(math.isfinite, interval)) else None, ""


@dataclass(frozen=True, kw_only=True)
class SiblingAnalysis:
    """What each sibling adds: departures and baselines per simulator, nesting and residuals per pair, information."""

    departures: Sequence[Departures]
    nesting: Sequence[Nesting]
    baselines: Sequence[Baseline]
    residuals: Sequence[ResidualCorrelation]
    information: Sequence[AddedInformation]

    def document(self) -> dict[str, Any]:
        """Convert to JSON values."""
        return {
            "departures": [asdict(one) for one in self.departures],
            "nesting": [asdict(one) for one in self.nesting],
            "baselines": [{**asdict(one), "chosen": dict(one.chosen)} for one in self.baselines],
            "residual_correlations": [asdict(one) for one in self.residuals],
            "information": [
                {**asdict(one), "verdict": one.verdict, "sentence": one.sentence} for one in self.information
            ],
        }

    @property
    def feature(self) -> str:
        """Feature that was chosen for most failures, over all simulators; a bend of the driven lane if none was."""
        votes: Counter[str] = Counter()
        for one in self.baselines:
            votes.update({name: one.failures * share for name, share in one.chosen.items()})
        return max(votes, key=lambda name: votes[name], default="lane_curvature_max_right")

    @property
    def sentences(self) -> list[str]:
        """What each sibling adds, one line each."""
        return [one.sentence for one in self.information]

    @property
    def answer(self) -> list[str]:
        """Which siblings add something, one line for each simulator that they are to predict."""
        said = []
        for about in dict.fromkeys(one.about for one in self.information):
            of = [one for one in self.information if one.about == about]
            if of[0].bits is None:
                said.append(f"Whether a sibling adds anything about {about} is open: {of[0].caution}.")
                continue
            adding = [one.sibling for one in of if one.verdict == "adds information"]
            rest = [one.sibling for one in of if one.sibling not in adding]
            add = "adds" if len(adding) == 1 else "add"
            parts = [f"{listed(adding)} {add} information about {about} beyond road features"] * bool(adding)
            parts += [f"nothing is shown that {listed(rest)} would add about {about}"] * bool(rest)
            said.append(f"{'; '.join(parts)}.")
        return said


def analyse(table: RoadTable, about: Sequence[SimulatorName], *, repeats: int = REPEATS) -> SiblingAnalysis:
    """Analyse tests with a verdict on every simulator; each of `about` is predicted from the others."""
    return SiblingAnalysis(
        departures=departures_of(table),
        nesting=nestings(table),
        baselines=[baseline_of(table, name, repeats=repeats) for name in table.simulators],
        residuals=residual_correlations(table, repeats=repeats),
        information=[
            one
            for name in about
            for one in information_about(
                table, name, [other for other in table.simulators if other != name], repeats=repeats
            )
        ],
    )


def analysis_tables(analysis: SiblingAnalysis) -> list[Table]:
    """Tabulate an analysis, in the order of its attributes."""
    scores = []
    for one in analysis.baselines:
        chosen = ", ".join(f"{name} ({share:.0%})" for name, share in one.chosen.items())
        start = (one.simulator, one.failures, one.roads, one.entropy)
        for predicted_from, score, features in (
            ("best single feature", one.best, chosen),
            ("all features", one.all, ""),
        ):
            numbers = [None] * 5 if score is None else vars(score).values()
            scores.append((*start, predicted_from, *numbers, features))
    return [
        Table(
            name="sibling_departures",
            title="How failures leave the lane: wide is out of a bend, to cut is into it",
            columns=[Column("simulator"), Column("failures", "count"), *(Column(kind, "count") for kind in KINDS)],
            rows=[(one.simulator, one.failures, *(one.counts[kind] for kind in KINDS)) for one in analysis.departures],
        ),
        Table(
            name="sibling_nesting",
            title="Do failures lie inside each other? Roads on which both, one or none fails",
            columns=[
                Column("pair"),
                *styled("count", "both", "first only", "second only", "neither"),
                *styled(
                    "number", "second fails where first does", "95 %", "first fails where second does", "95 % of that"
                ),
            ],
            rows=[(f"{one.first}, {one.second}", *list(vars(one).values())[2:]) for one in analysis.nesting],
        ),
        Table(
            name="sibling_baseline",
            title="Without driving: failures predicted from road features and conditions",
            columns=[
                Column("failures on"),
                *styled("count", "failures", "roads"),
                Column("entropy", "number"),
                Column("predicted from"),
                *styled("number", "AUC-ROC", "95 %", "Brier score", "95 % of Brier", "bits left"),
                Column("chosen on other roads"),
            ],
            rows=scores,
            notes=[one.caution for one in analysis.baselines if one.caution],
        ),
        Table(
            name="sibling_residuals",
            title="What is left: correlation of lateral positions beyond the best feature",
            columns=[
                Column("pair"),
                *styled("number", "largest per road", "95 %", "beyond the best feature", "95 % of it"),
                *styled("number", "per place, beyond curvature", "95 % of that"),
            ],
            rows=[(f"{one.first}, {one.second}", *list(vars(one).values())[2:-1]) for one in analysis.residuals],
            notes=list(
                dict.fromkeys(part for one in analysis.residuals if one.caution for part in one.caution.split("; "))
            ),
        ),
        Table(
            name="sibling_information",
            title="Information that each sibling adds, bits a road",
            columns=[
                *styled("text", "about", "sibling", "beyond"),
                *styled("number", "bits left before", "adds", "95 %"),
                Column("verdict"),
            ],
            rows=[
                (
                    one.about,
                    one.sibling,
                    ", ".join(("features", *one.beyond)),
                    one.left,
                    one.bits,
                    one.interval,
                    one.verdict,
                )
                for one in analysis.information
            ],
            notes=list(dict.fromkeys(one.caution for one in analysis.information if one.caution)),
        ),
    ]


def outcome_rows(table: RoadTable) -> list[dict[str, Any]]:
    """Every road with its features and its outcomes, as JSON values."""
    return [
        {
            "road_id": road.road_id,
            "lane": road.lane,
            **dict(zip(table.feature_names, map(float, table.features[k]), strict=True)),
            "failed": {name: bool(table.failed(name)[k]) for name in table.simulators},
            "max_lateral_position": dict(zip(table.simulators, map(float, table.lateral[k]), strict=True)),
        }
        for k, road in enumerate(table.roads)
    ]
