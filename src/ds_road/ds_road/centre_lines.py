# SPDX-License-Identifier: Apache-2.0
"""Centre lines of any length, before they become roads of the box."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ds_road.geometry import BOX, arc_lengths
from ds_road.road import MAX_POINTS, Road, RoadError, Side

Points = NDArray[np.float64]
SAME = 0.01
"""m; distance of two points that are one; chosen: the gap between pieces that ASAM's checker allows."""
LONGEST_SECTION = 900.0
"""m; chosen: longer ones hardly fit into the box."""


@dataclass(frozen=True)
class CentreLine:
    """A line beside which a lane lies."""

    name: str  # as in the file, or of the file
    points: Points  # (n, 2) m, in driving order
    lane_width: float  # m
    lane: Side = "right"  # driven
    made: Road | None = None  # the road, where it is known already

    @classmethod
    def of(cls, name: str, road: Road) -> CentreLine:
        """The centre line of a road that is known already, as one of control points."""
        return cls(name, road.points, road.lane_width, road.lane, road)

    def in_lane(self, lane: Side | None) -> CentreLine:
        """The same line and lane width, driven in another lane; as it is if None."""
        if lane is None:
            return self
        return replace(self, lane=lane, made=self.made and self.made.in_lane(lane))

    @property
    def _without_return(self) -> Points:
        """Points without the last one where that is the first one again."""
        again = len(self.points) > 3 and np.hypot(*(self.points[-1] - self.points[0])) < SAME
        return self.points[:-1] if again else self.points

    @property
    def length(self) -> float:
        """Length, m."""
        return float(arc_lengths(self.points)[-1])

    @property
    def closed(self) -> bool:
        """Whether the end is next to the start, as on a race track."""
        gap = float(np.hypot(*(self.points[-1] - self.points[0])))
        return len(self.points) > 3 and gap < 0.05 * self.length and gap < 3.0 * self.length / len(self.points)

    def road(self) -> Road:
        """The road, if it can be one; of a line with more points than a road may have, evenly chosen ones."""
        if self.made is not None:
            return self.made
        points = self._without_return
        if len(points) > MAX_POINTS:
            points = points[np.linspace(0, len(points) - 1, MAX_POINTS).round().astype(int)]
        return Road.from_road_points(points, lane_width=self.lane_width, lane=self.lane)

    def sections(self, length: float, every: float) -> list[CentreLine]:
        """Cut sections of `length` m, one every so many metres; those of a closed line run over its end."""
        if not 0 < length <= LONGEST_SECTION or not every > 0:
            raise RoadError(f"sections of {length:g} m every {every:g} m, expected at most {LONGEST_SECTION:g} m long")
        if length > self.length:
            raise RoadError(f"{self.name} is {self.length:.0f} m long, expected {length:g} m: cut shorter sections")
        points, last = self.points, self.length - length + 1e-9
        if self.closed:
            points = np.vstack((self._without_return, points[:1]))
            last = arc_lengths(points)[-1] - 1e-9
            points = np.vstack((points, points[1:]))
        along = arc_lengths(points)
        return [
            replace(self, name=f"{self.name}_{start:.0f}", points=_between(points, along, start, length), made=None)
            for start in np.arange(0.0, last, every)
        ]


def _between(points: Points, along: Points, start: float, length: float) -> Points:
    inside = (along > start + 1e-6) & (along < start + length - 1e-6)
    ends = np.stack([np.interp((start, start + length), along, points[:, axis]) for axis in (0, 1)], axis=1)
    return np.vstack((ends[:1], points[inside], ends[1:]))


def in_box(road: Road) -> tuple[Road, tuple[float, float]]:
    """A road of road points that fits into the box, moved into its middle if it lies outside; and by how much, m."""
    edges = np.vstack((road.left_edge, road.right_edge))
    low, high = edges.min(axis=0), edges.max(axis=0)
    inside = low.min() >= 0 and high.max() <= BOX
    if inside or not road.sampled or (high - low).max() > BOX:
        return road, (0.0, 0.0)
    shift = np.round(BOX / 2 - (low + high) / 2, 3)
    return replace(road, control_points=road.points + shift), (float(shift[0]), float(shift[1]))
