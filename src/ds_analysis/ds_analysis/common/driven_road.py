# SPDX-License-Identifier: Apache-2.0
"""What became of a road on a simulator, and the lateral positions of its vehicle along the lane."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ds_analysis.common.statistics import Array
from ds_orchestrator.store.model import Execution
from ds_road import Road
from ds_sim.oracle import LaneTracker
from ds_sim.session import RunRecord
from ds_sim.simulator import Outcome

GRID = 0.5
"""Arc length between two places at which lateral positions are compared, m; chosen: the distance of two frames."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DrivenRoad:
    """What became of one road on one simulator.

    Attributes:
        max_lateral_position: largest absolute lateral position of the run, m.
        path: (frames, 2) positions, m.
        profile: lateral positions along the lane; see `lateral_profile`.
    """

    road: Road
    outcome: Outcome
    max_lateral_position: float = 0.0
    path: Array = field(default_factory=lambda: np.empty((0, 2)))
    profile: Array = field(default_factory=lambda: np.empty(0))

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


def places_along(road: Road, trajectory: Array) -> Array:
    """(frames,) arc length at which the centre of the lane is nearest to each frame of a stored trajectory, m."""
    start, ahead = road.lane_centre[:-1].T, np.diff(road.lane_centre, axis=0).T
    lengths = np.hypot(*ahead)
    to_x, to_y = (trajectory[:, k, None] - start[k] for k in (0, 1))
    along = np.clip((to_x * ahead[0] + to_y * ahead[1]) / lengths**2, 0.0, 1.0)
    nearest = np.argmin((to_x - along * ahead[0]) ** 2 + (to_y - along * ahead[1]) ** 2, axis=1)
    return np.asarray((np.cumsum(lengths) - lengths + along * lengths)[np.arange(len(nearest)), nearest])


def lateral_profile(arc: Array, lateral: Array, half_lane: float) -> Array:
    """Lateral positions, m, every `GRID` m of the lane as far as a run went, clipped to `half_lane` on either side."""
    if not len(arc):
        return np.empty(0)
    along = np.maximum.accumulate(arc)
    places = np.arange(GRID, along[-1], GRID)
    return np.asarray(np.interp(places, along, np.clip(lateral, -half_lane, half_lane)), np.float64)
