"""The road: an immutable value made of control points, with everything that follows from them."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ds_road.features import curvature, turns_count
from ds_road.spline import catmull_rom
from ds_road.validity import Validity, check_surface

LANE_WIDTH = 4.0
"""m (maxitwo: a road of 8 m with two lanes)."""
MAX_POINTS = 1000
"""Control points at most; chosen: a hundred times the paper's nine, and checked within a second."""
_LARGEST = 1e6


class RoadError(ValueError):
    """Something of which no road can be made, or a road on which nobody can drive."""


class Road:
    """A two-lane road through control points (paper 3.1.1), driven in the right lane.

    The first and the last control point only give the spline its direction: the road starts at the second and ends
    at the second last. Equal control points make equal roads.

    Args:
        control_points: (n, 2) numbers, m, 4 <= n <= 1000.

    Raises:
        RoadError: not such numbers, or two neighbours that are equal.
    """

    def __init__(self, control_points: Iterable[Sequence[float]] | NDArray[np.float64]) -> None:
        self.control_points = _checked(control_points)
        self.lane_width = LANE_WIDTH

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Road) and self.control_points == other.control_points

    def __hash__(self) -> int:
        return hash(self.control_points)

    def __repr__(self) -> str:
        return f"Road({self.road_id}, {len(self.control_points)} control points)"

    @cached_property
    def road_id(self) -> str:
        """Twelve hexadecimal digits that stand for the control points."""
        data = np.asarray(self.control_points, dtype="<f8").tobytes()
        return hashlib.sha256(data).hexdigest()[:12]

    @cached_property
    def points(self) -> NDArray[np.float64]:
        """Samples of the centre line, (20 + 19 (n - 4), 2), m."""
        return _frozen(catmull_rom(np.array(self.control_points)))

    @cached_property
    def _across(self) -> NDArray[np.float64]:
        """Unit vectors to the right at every sample: across the step to the next one, at the end to the last one."""
        steps = np.diff(self.points, axis=0)
        steps = np.vstack((steps, steps[-1:]))
        steps = steps / np.hypot(steps[:, 0], steps[:, 1])[:, None]
        return np.stack((steps[:, 1], -steps[:, 0]), axis=1)

    @cached_property
    def left_edge(self) -> NDArray[np.float64]:
        """Left border of the road at every sample, (n, 2), m."""
        return _frozen(self.points - self.lane_width * self._across)

    @cached_property
    def right_edge(self) -> NDArray[np.float64]:
        """Right border of the road at every sample, (n, 2), m."""
        return _frozen(self.points + self.lane_width * self._across)

    @cached_property
    def right_lane_centre(self) -> NDArray[np.float64]:
        """Centre line of the right lane at every sample, (n, 2), m."""
        return _frozen(self.points + self.lane_width / 2 * self._across)

    @cached_property
    def length(self) -> float:
        """Length of the centre line, m."""
        return float(np.hypot(*np.diff(self.points, axis=0).T).sum())

    @cached_property
    def curvature(self) -> float:
        """Largest curvature of the centre line, 1/m; see `ds_road.features.curvature`."""
        return curvature(self.points)

    @property
    def curvature_bin(self) -> int:
        """Place of the curvature in a feature map: int(100 x curvature) (maxitwo)."""
        return int(100 * self.curvature)

    @cached_property
    def turns_count(self) -> int:
        """Number of turns; see `ds_road.features.turns_count`."""
        return turns_count(self.points)

    @cached_property
    def turns_count_published(self) -> int:
        """Number of turns as the authors' package counts them."""
        return turns_count(self.points, published=True)

    @cached_property
    def validity(self) -> Validity:
        """Whether the road can be driven (paper 3.1.3)."""
        return check_surface(self.left_edge, self.right_edge)

    def reversed(self) -> Road:
        """The same control points driven the other way."""
        return Road(self.control_points[::-1])


def _frozen(array: NDArray[np.float64]) -> NDArray[np.float64]:
    array.setflags(write=False)
    return array


def _checked(raw: Any) -> tuple[tuple[float, float], ...]:
    """Control points as pairs of finite floats."""
    try:
        points = list(raw)
    except TypeError:
        raise RoadError(f"a road is {type(raw).__name__}, expected a list of [x, y] control points in metres") from None
    if not 4 <= len(points) <= MAX_POINTS:
        raise RoadError(f"a road has {len(points)} control points, expected 4 to {MAX_POINTS}")
    pairs: list[tuple[float, float]] = []
    for index, point in enumerate(points):
        try:
            x, y = point
            pair = (float(x), float(y))
        except (TypeError, ValueError, OverflowError):
            raise RoadError(f"control point {index} is {str(point)[:40]!r}, expected two numbers [x, y]") from None
        if isinstance(x, str | bool) or isinstance(y, str | bool) or not all(abs(v) <= _LARGEST for v in pair):
            raise RoadError(f"control point {index} is {str(point)[:40]}, expected finite metres up to {_LARGEST:g}")
        if pairs and pair == pairs[-1]:
            raise RoadError(f"control points {index - 1} and {index} are equal: remove one of them")
        pairs.append(pair)
    return tuple(pairs)
