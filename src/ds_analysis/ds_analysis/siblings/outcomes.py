"""Outcomes of one driver on the same roads on several simulators, as arrays."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import shapely
from numpy.typing import NDArray

from ds_analysis.common.families import Indices, families_of
from ds_analysis.paper.simulator_agreement import DrivenRoad, lateral_profile
from ds_road import Road
from ds_road.geometry import direction_coverage
from ds_sim.conditions.model import FIELDS, Conditions
from ds_sim.conditions.scales import share_of

if TYPE_CHECKING:
    from ds_orchestrator.campaign.folder import CampaignData

ROAD_FEATURES: Mapping[str, Callable[[Road], float]] = {
    "length": lambda road: road.length,
    "turns_count": lambda road: float(road.turns_count),
    "curvature": lambda road: road.curvature,
    "direction_coverage": lambda road: direction_coverage(road.points),
    "lane_curvature_max_right": lambda road: road.lane_curvature_max_right,
    "lane_curvature_max_left": lambda road: road.lane_curvature_max_left,
}
"""Features of a road alone that predict failures; those of the maps that repeat one of them are left out
(`segment_count` is the turns count, `minimum_radius` the inverse of the curvature)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcomes:
    """Outcomes of one driver on the same roads on several simulators.

    Attributes:
        simulators: names of the simulators, siblings in their order.
        roads: roads with a verdict on every simulator.
        failed: (roads, simulators) whether the run failed.
        lateral: (roads, simulators) largest absolute lateral position, m, at most half a lane: how far a car goes after
            leaving its lane does not tell how it drove.
        profiles: per simulator and road the lateral positions every `GRID` m along the lane, m.
        conditions: (roads,) operating conditions; the default ones if None.
        left_out: number of roads without a verdict on some simulator.
    """

    simulators: tuple[str, ...]
    roads: tuple[Road, ...]
    failed: NDArray[np.bool_]
    lateral: NDArray[np.float64]
    profiles: Mapping[str, Sequence[NDArray[np.float64]]]
    conditions: tuple[Conditions, ...] | None = None
    left_out: int = 0

    @cached_property
    def feature_names(self) -> tuple[str, ...]:
        """Names of what is known of a road before it is driven: `ROAD_FEATURES`, then the conditions that differ."""
        return (*ROAD_FEATURES, *condition_columns(self.conditions or ()))

    @cached_property
    def features(self) -> NDArray[np.float64]:
        """(roads, features) values of `feature_names`; each condition as a share of its range on its scale."""
        rows = [[of(road) for of in ROAD_FEATURES.values()] for road in self.roads]
        of_roads = np.array(rows, np.float64).reshape(len(self.roads), len(ROAD_FEATURES))
        return np.column_stack((of_roads, *condition_columns(self.conditions or ()).values()))

    def feature(self, name: str) -> NDArray[np.float64]:
        """(roads,) values of one feature."""
        return self.features[:, self.feature_names.index(name)]

    @cached_property
    def families(self) -> Indices:
        """(roads,) number of the family of mutants to which a road belongs."""
        return families_of(self.roads)

    def failures(self, simulator: str) -> NDArray[np.bool_]:
        """(roads,) whether the run on one simulator failed."""
        return self.failed[:, self.simulators.index(simulator)]

    def largest_lateral(self, simulator: str) -> NDArray[np.float64]:
        """(roads,) largest absolute lateral position on one simulator, m."""
        return self.lateral[:, self.simulators.index(simulator)]


def outcomes_of_runs(runs: Mapping[str, Sequence[DrivenRoad]]) -> Outcomes:
    """Collect the outcomes of runs.

    Args:
        runs: simulator -> its runs, the same roads in the same order for all.
    """
    rows = list(zip(*runs.values(), strict=True))
    judged = [row for row in rows if all(run.outcome.is_verdict for run in row)]
    return _outcomes(
        tuple(runs),
        [row[0].road for row in judged],
        [[run.outcome.is_failure for run in row] for row in judged],
        [[run.max_lateral_position for run in row] for row in judged],
        {name: [row[column].profile for row in judged] for column, name in enumerate(runs)},
        left_out=len(rows) - len(judged),
    )


def outcomes_of_campaign(data: CampaignData) -> Outcomes:
    """Collect the outcomes of a campaign's tests, each test a road."""
    names = tuple(data.config.simulators)
    done = {(e.test_id, e.simulator): e for e in data.verdicts}
    rows = [[done.get((test.test_id, name)) for name in names] for test in data.tests]
    judged = [
        (test, [one for one in row if one is not None])
        for test, row in zip(data.tests, rows, strict=True)
        if None not in row
    ]
    return _outcomes(
        names,
        [test.road for test, _ in judged],
        [[one.outcome.is_failure for one in row] for _, row in judged],
        [[one.max_lateral_position for one in row] for _, row in judged],
        {
            name: [recorded_profile(test.road, row[column].trajectory) for test, row in judged]
            for column, name in enumerate(names)
        },
        conditions=tuple(test.conditions for test, _ in judged),
        left_out=len(rows) - len(judged),
    )


def condition_columns(conditions: Sequence[Conditions]) -> Mapping[str, NDArray[np.float64]]:
    """Conditions that differ between tests, as shares of their ranges on their scales, a column each.

    One that a simulator chooses itself cannot be compared, and is left out.
    """
    columns = {}
    for name, field in FIELDS.items():
        values = [getattr(one, name) for one in conditions]
        if len(set(values)) > 1 and None not in values:
            columns[name] = np.array([share_of(name, field.low, field.high, value) for value in values])
    return columns


def _outcomes(
    simulators: tuple[str, ...],
    roads: Sequence[Road],
    failed: Sequence[Sequence[bool]],
    lateral: Sequence[Sequence[float]],
    profiles: Mapping[str, Sequence[NDArray[np.float64]]],
    *,
    conditions: tuple[Conditions, ...] | None = None,
    left_out: int,
) -> Outcomes:
    shape = len(roads), len(simulators)
    half_lanes = np.array([road.lane_width / 2 for road in roads])
    return Outcomes(
        simulators=simulators,
        roads=tuple(roads),
        failed=np.array(failed, np.bool_).reshape(shape),
        lateral=np.minimum(np.array(lateral, np.float64).reshape(shape), half_lanes[:, None]),
        profiles=profiles,
        conditions=conditions,
        left_out=left_out,
    )


def recorded_profile(road: Road, trajectory: NDArray[np.float64]) -> NDArray[np.float64]:
    """Lateral positions every `GRID` m of a stored trajectory (x, y, yaw, speed, lateral position).

    In its lane, a vehicle is nearer to the lane's centre than to any other part of the road's.
    """
    arc = shapely.line_locate_point(shapely.LineString(road.lane_centre), shapely.points(trajectory[:, :2]))
    return lateral_profile(arc, trajectory[:, 4], road.lane_width / 2)
