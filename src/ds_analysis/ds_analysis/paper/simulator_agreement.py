"""Measures how differently simulators behave with the same driver on the same roads (complementarity, paper 3.2)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from statsmodels.stats.inter_rater import cohens_kappa

from ds_orchestrator.store.model import Execution
from ds_road import Road
from ds_sim.lane_tracker import LaneTracker
from ds_sim.session import RunRecord
from ds_sim.simulator import Outcome

GRID = 0.5
"""Arc length between two places at which lateral positions are compared, m; chosen: the distance of two frames."""
APART = 0.5
"""Distance from which two lateral positions count as apart, m; chosen: a quarter of half a lane."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DrivenRoad:
    """What became of one road on one simulator.

    Attributes:
        road: the road.
        outcome: how the run ended.
        max_lateral_position: largest absolute lateral position of the run, m.
        path: (frames, 2) positions, m.
        profile: lateral positions along the lane; see `lateral_profile`.
    """

    road: Road
    outcome: Outcome
    max_lateral_position: float = 0.0
    path: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 2)))
    profile: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))

    @classmethod
    def of_run(cls, run: RunRecord) -> DrivenRoad:
        """Take what matters from a run."""
        arc = np.array([o.lane.arc_length for o in run.observations], np.float64)
        lateral = np.array([o.lane.lateral_position for o in run.observations])
        return cls(
            road=run.road,
            outcome=run.outcome,
            max_lateral_position=run.max_lateral_position,
            path=np.array([(o.vehicle.x, o.vehicle.y) for o in run.observations], np.float64).reshape(-1, 2),
            profile=lateral_profile(arc, lateral, run.road.lane_width / 2),
        )

    @classmethod
    def of_execution(cls, road: Road, execution: Execution) -> DrivenRoad:
        """The same from a store, whose trajectories have no arc lengths: they are found as a simulator finds them."""
        path, tracker = execution.trajectory[:, :2], LaneTracker(road.lane_centre)
        arc = np.array([tracker.update(x, y)[1] for x, y in path.tolist()], np.float64)
        return cls(
            road=road,
            outcome=execution.outcome,
            max_lateral_position=execution.max_lateral_position,
            path=path,
            profile=lateral_profile(arc, execution.trajectory[:, 4], road.lane_width / 2),
        )


@dataclass(frozen=True, kw_only=True)
class PairComparison:
    """Comparison of two simulators on the same roads.

    Attributes:
        first: name of the first simulator.
        second: name of the second simulator.
        roads: number of roads on which both runs ended with a verdict.
        both_fail: number of roads on which both runs failed.
        only_first_fails: number of roads on which only the first run failed.
        only_second_fails: number of roads on which only the second run failed.
        both_complete: number of roads on which neither run failed.
        kappa: Cohen's kappa of the verdicts; None if undefined.
        kappa_interval: asymptotic 95 % interval of kappa (statsmodels), clipped to [-1, 1].
        reason: why there is no kappa, or "".
        median_apart: median distance between the lateral positions over all places, m.
        apart_95: 95th percentile of that distance, m.
        most_apart: largest distance, m.
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


def compare(runs: Mapping[str, Sequence[DrivenRoad]]) -> list[PairComparison]:
    """Compare every pair of simulators.

    Args:
        runs: simulator -> its runs, the same roads in the same order for all.

    Returns:
        One comparison per pair, in the order of the mapping. Runs that ended in an error are left out.
    """
    return [_pair(a, b, list(zip(runs[a], runs[b], strict=True))) for a, b in combinations(runs, 2)]


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


def most_different(runs: Mapping[str, Sequence[DrivenRoad]], count: int) -> list[int]:
    """Find the indices of the roads on which two simulators get farthest apart, the farthest first."""
    total = len(next(iter(runs.values())))
    widest = [
        max((float(gap.max()) for a, b in combinations(runs, 2) if len(gap := gaps(runs[a][i], runs[b][i]))), default=0)
        for i in range(total)
    ]
    return sorted(range(total), key=lambda i: (-widest[i], i))[:count]


def gaps(one: DrivenRoad, other: DrivenRoad) -> NDArray[np.float64]:
    """Compute the distance between the lateral positions of two runs, m, every `GRID` m that both covered."""
    first, second = _lateral(one, other)
    return np.abs(first - second)


def _lateral(one: DrivenRoad, other: DrivenRoad) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lateral positions of two runs at the places that both covered."""
    both = min(len(one.profile), len(other.profile))
    return one.profile[:both], other.profile[:both]


def lateral_profile(arc: NDArray[np.float64], lateral: NDArray[np.float64], half_lane: float) -> NDArray[np.float64]:
    """Interpolate lateral positions at the places `GRID`, 2 `GRID`, ... m along the lane, as far as the run went.

    Args:
        arc: (frames,) arc length along the lane, m.
        lateral: (frames,) lateral position, m.
        half_lane: half the width of the lane, m. Positions are clipped there: how far a car goes after leaving the lane
            does not tell where it failed.

    Returns:
        (places,) lateral positions, m.
    """
    if not len(arc):
        return np.empty(0)
    along = np.maximum.accumulate(arc)
    places = np.arange(GRID, along[-1], GRID)
    return np.asarray(np.interp(places, along, np.clip(lateral, -half_lane, half_lane)), np.float64)


def _pair(first: str, second: str, pairs: list[tuple[DrivenRoad, DrivenRoad]]) -> PairComparison:
    judged = [(a, b) for a, b in pairs if a.outcome.is_verdict and b.outcome.is_verdict]
    table = np.zeros((2, 2), int)
    for a, b in judged:
        table[int(a.outcome.is_failure), int(b.outcome.is_failure)] += 1
    kappa, interval, reason = _kappa(first, second, table)
    laterals = [_lateral(a, b) for a, b in judged]
    ones, others = (np.concatenate([pair[i] for pair in laterals]) if laterals else np.empty(0) for i in (0, 1))
    apart = np.abs(ones - others)
    known = len(apart) > 0
    varied = known and ones.std() > 0 and others.std() > 0
    return PairComparison(
        first=first,
        second=second,
        roads=len(judged),
        both_fail=int(table[1, 1]),
        only_first_fails=int(table[1, 0]),
        only_second_fails=int(table[0, 1]),
        both_complete=int(table[0, 0]),
        kappa=kappa,
        kappa_interval=interval,
        reason=reason,
        median_apart=float(np.median(apart)) if known else None,
        apart_95=float(np.percentile(apart, 95)) if known else None,
        most_apart=float(apart.max()) if known else None,
        share_apart=float((apart > APART).mean()) if known else None,
        correlation=float(np.corrcoef(ones, others)[0, 1]) if varied else None,
    )


def _kappa(first: str, second: str, table: NDArray[np.int_]) -> tuple[float | None, tuple[float, float] | None, str]:
    """Compute Cohen's kappa of a table of verdicts (rows: first, columns: second) and its interval, or the reason."""
    if table.sum() == 0:
        return None, None, "no road was driven to a verdict on both"
    for name, counts in ((first, table.sum(axis=1)), (second, table.sum(axis=0))):
        if 0 in counts:
            verdict = "completes" if counts[1] == 0 else "fails"
            return None, None, f"{name} {verdict} every road: agreement beyond chance is not defined"
    found = cohens_kappa(table)
    # The asymptotic interval may leave kappa's range.
    interval = max(float(found.kappa_low), -1.0), min(float(found.kappa_upp), 1.0)
    return float(found.kappa), interval if all(map(math.isfinite, interval)) else None, ""
