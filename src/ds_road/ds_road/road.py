# SPDX-License-Identifier: Apache-2.0
"""Road: an immutable value defined by its control points, with everything derived from them."""

from __future__ import annotations

import hashlib
import reprlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from ds_base.errors import InputError
from ds_road.geometry import BOX, Validity, catmull_rom, check_surface, curvature, largest_lane_curvature, turns_count

Side = Literal["right", "left", "middle", "single"]
"""Lane that is driven: to the right or the left of the centre line as seen in driving order, one around the centre line
of two lanes, or the only lane of a road, between two edge lines and without a centre line."""
_MIRRORED: Mapping[Side, Side] = {"right": "left", "left": "right"}
LANE_WIDTH = 4.0
"""Default width of a lane, m (maxitwo: a two-lane road of 8 m)."""
MAX_POINTS = 1000
"""Largest number of control points; chosen: a hundred times the paper's nine, still checked within a second."""
MIN_SPACING = 1e-3
"""Smallest distance between neighbouring points, m; chosen: floating point cannot resolve a direction below it."""
_MAX_COORDINATE = 1e6


class RoadError(InputError):
    """Input that does not define a road, or a road that cannot be driven."""


@dataclass(frozen=True, init=False, repr=False)
class Road:
    """Two-lane road through control points (paper 3.1.1), driven in its right lane, or in another one.

    The first and the last control point only set the direction of the spline: the road starts at the second one and
    ends at the last but one. Roads with equal content compare equal and have the same `road_id`.

    Args:
        control_points: (n, 2) coordinates, m, in driving order, 4 <= n <= 1000.
        lane_width: width of each of the two lanes, m, 1 to 20.
        maxitwo_compatible: build the centre line as maxitwo does for mutants: the spline ignores the first control
            point, so that the road starts at the third (n >= 5). This does not affect how turns are counted:
            `turns_count_maxitwo` exists for every road.
        sampled: the points are the centre line itself; see `from_road_points`.
        lane: lane that is driven, from the first to the last control point in each; see `Side`.

    Raises:
        RoadError: the arguments do not define a road, or two neighbouring points are less than a millimetre apart.

    Examples:
        >>> from ds_road import Road
        >>> road = Road([(125, 0), (125, 25), (125, 50), (140, 75), (165, 90)])
        >>> road.turns_count, round(road.length, 1), road.validity.valid
        (1, 54.6, True)
        >>> road.mirrored().turns_count, road.in_lane("left").lane
        (1, 'left')
    """

    control_points: tuple[tuple[float, float], ...]
    lane_width: float
    maxitwo_compatible: bool
    sampled: bool
    lane: Side

    def __init__(
        self,
        control_points: Iterable[Sequence[float]] | NDArray[np.float64],
        *,
        lane_width: float = LANE_WIDTH,
        maxitwo_compatible: bool = False,
        sampled: bool = False,
        lane: Side = "right",
    ) -> None:
        if sampled and maxitwo_compatible:
            raise RoadError("the road is both sampled and maxitwo_compatible: expected at most one of them")
        if sampled:
            points = _parse_points(control_points, "road point", minimum=2)
        else:
            points = _parse_points(control_points, "control point", minimum=5 if maxitwo_compatible else 4)
        if isinstance(lane_width, str | bool) or not isinstance(lane_width, int | float) or not 1 <= lane_width <= 20:
            raise RoadError(f"lane width is {abbreviated(lane_width)}, expected 1 to 20 metres")
        if not isinstance(lane, str) or lane not in get_args(Side):
            raise RoadError(f"lane is {abbreviated(lane)}, expected one of {', '.join(get_args(Side))}")
        values = (points, float(lane_width), bool(maxitwo_compatible), sampled, lane)
        for field, value in zip(fields(self), values, strict=True):
            object.__setattr__(self, field.name, value)

    @classmethod
    def from_road_points(
        cls,
        points: Iterable[Sequence[float]] | NDArray[np.float64],
        *,
        lane_width: float = LANE_WIDTH,
        lane: Side = "right",
    ) -> Road:
        """Road whose centre line is given point by point, the way other tools in this field exchange roads.

        The points become its `control_points`, and `sampled` is true: no spline is fitted to them.

        Args:
            points: (n, 2) coordinates, m, in driving order, 2 <= n <= 1000.
            lane_width: width of each of the two lanes, m, 1 to 20.
            lane: lane that is driven; see `Side`.

        Raises:
            RoadError: the arguments do not define a road, or two neighbouring points are less than a millimetre apart.

        Examples:
            >>> from ds_road import Road
            >>> road = Road.from_road_points([(0, 0), (0, 20), (5, 40)], lane_width=3.5)
            >>> road.sampled, round(road.length, 2)
            (True, 40.62)
        """
        return cls(points, lane_width=lane_width, sampled=True, lane=lane)

    def __getstate__(self) -> dict[str, Any]:
        """Pickle only the fields that define the road, not the cached properties."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def __repr__(self) -> str:
        kind = "road points" if self.sampled else "control points"
        quirk = ", maxitwo-compatible" if self.maxitwo_compatible else ""
        lane = "" if self.lane == "right" else f", {self.lane} lane"
        return f"Road({self.road_id}, {len(self.control_points)} {kind}{quirk}{lane})"

    @cached_property
    def road_id(self) -> str:
        """Twelve hexadecimal digits of a hash over the control points, how they make the road, and its lane."""
        content = hashlib.sha256(np.asarray(self.control_points, dtype="<f8").tobytes())
        if self.sampled or self.maxitwo_compatible or self.lane_width != LANE_WIDTH:
            content.update(f"{self.lane_width} {self.maxitwo_compatible} {self.sampled}".encode())
        if self.lane != "right":
            content.update(self.lane.encode())
        return content.hexdigest()[:12]

    @cached_property
    def points(self) -> NDArray[np.float64]:
        """Samples of the centre line, (20 + 19 (n - 4), 2), m; the points themselves on a sampled road.

        n is the number of control points, minus one on a maxitwo-compatible road, whose spline ignores the first one.
        """
        control = np.array(self.control_points)
        if self.sampled:
            return _read_only(control)
        return _read_only(catmull_rom(control[1:] if self.maxitwo_compatible else control))

    @cached_property
    def _right_normals(self) -> NDArray[np.float64]:
        """Unit vectors to the right of every sample, (n, 2): normal to the next step, at the end to the last step."""
        steps = np.diff(self.points, axis=0)
        steps = np.vstack((steps, steps[-1:]))
        steps = steps / np.hypot(steps[:, 0], steps[:, 1])[:, None]
        return np.stack((steps[:, 1], -steps[:, 0]), axis=1)

    @property
    def half_width(self) -> float:
        """Distance of either border from the centre line, m: a lane's width, or half of it where it is the only one."""
        return self.lane_width / 2 if self.lane == "single" else self.lane_width

    @property
    def has_centre_line(self) -> bool:
        """Whether a line is painted between two lanes."""
        return self.lane != "single"

    @cached_property
    def left_edge(self) -> NDArray[np.float64]:
        """Left border of the road at every sample, (n, 2), m."""
        return _read_only(self.points - self.half_width * self._right_normals)

    @cached_property
    def right_edge(self) -> NDArray[np.float64]:
        """Right border of the road at every sample, (n, 2), m."""
        return _read_only(self.points + self.half_width * self._right_normals)

    @cached_property
    def right_lane_centre(self) -> NDArray[np.float64]:
        """Centre line of the right lane at every sample, (n, 2), m."""
        return _read_only(self.points + self.lane_width / 2 * self._right_normals)

    @cached_property
    def left_lane_centre(self) -> NDArray[np.float64]:
        """Centre line of the left lane at every sample, (n, 2), m."""
        return _read_only(self.points - self.lane_width / 2 * self._right_normals)

    @property
    def lane_centre(self) -> NDArray[np.float64]:
        """Centre line of the driven lane at every sample, (n, 2), m."""
        return self._centre_of(self.lane)

    @property
    def other_lane_centre(self) -> NDArray[np.float64]:
        """Centre line of the lane beside the driven one at every sample, (n, 2), m; where there is none, its own."""
        return self._centre_of(_MIRRORED.get(self.lane, self.lane))

    def _centre_of(self, lane: Side) -> NDArray[np.float64]:
        if lane == "right":
            return self.right_lane_centre
        return self.left_lane_centre if lane == "left" else self.points

    @cached_property
    def length(self) -> float:
        """Length of the centre line, m."""
        return float(np.hypot(*np.diff(self.points, axis=0).T).sum())

    @cached_property
    def curvature(self) -> float:
        """Largest curvature of the centre line, 1/m; see `ds_road.geometry.curvature`."""
        return curvature(self.points)

    @cached_property
    def lane_curvature_max_right(self) -> float:
        """Largest curvature of the driven lane to the right, 1/m; see `ds_road.geometry.largest_lane_curvature`."""
        return largest_lane_curvature(self.lane_centre, "right")

    @cached_property
    def lane_curvature_max_left(self) -> float:
        """Largest curvature of the driven lane to the left, 1/m; see `ds_road.geometry.largest_lane_curvature`."""
        return largest_lane_curvature(self.lane_centre, "left")

    @cached_property
    def turns_count(self) -> int:
        """Number of turns; see `ds_road.geometry.turns_count`."""
        return turns_count(self.points)

    @cached_property
    def turns_count_maxitwo(self) -> int:
        """Number of turns as the authors' package (maxitwo) counts them."""
        return turns_count(self.points, maxitwo_compatible=True)

    @cached_property
    def validity(self) -> Validity:
        """Whether the road can be driven (paper 3.1.3)."""
        return check_surface(self.left_edge, self.right_edge)

    def remember(self, *, turns_count: int, curvature: float) -> None:
        """Take properties that were computed for this road before, instead of computing them again."""
        vars(self).update(turns_count=turns_count, curvature=curvature)

    def reversed(self) -> Road:
        """Road with the same centre line, driven in the opposite direction, in the lane of the same name.

        On a maxitwo-compatible road the first control point, which its spline ignores, is dropped.
        """
        used = self.control_points[1:] if self.maxitwo_compatible else self.control_points
        return replace(self, control_points=used[::-1], maxitwo_compatible=False)

    def in_lane(self, lane: Side) -> Road:
        """Return the same centre line and lane width, driven in another lane.

        Raises:
            RoadError: there is no such lane.
        """
        return replace(self, lane=lane)

    def mirrored(self) -> Road:
        """Return the mirror image about the middle of the box, x = 125 m, driven in the mirrored lane.

        A run on it is the mirror image of a run on this road: left and right change places, the start does not move
        on roads of `generate`.
        """
        mirrored = tuple((BOX - x, y) for x, y in self.control_points)
        return replace(self, control_points=mirrored, lane=_MIRRORED.get(self.lane, self.lane))


def abbreviated(value: Any) -> str:
    """Representation of any value for a one-line error message, truncated."""
    try:
        return reprlib.repr(value)
    except ValueError:  # an integer of thousands of digits
        return f"a huge {type(value).__name__}"


def _read_only(array: NDArray[np.float64]) -> NDArray[np.float64]:
    array.setflags(write=False)
    return array


def _parse_points(raw: Any, kind: str, *, minimum: int) -> tuple[tuple[float, float], ...]:
    """Convert raw points to pairs of finite floats; `kind` names a point in error messages."""
    if isinstance(raw, str | bytes | dict) or not isinstance(raw, Iterable):
        raise RoadError(f"a road is {type(raw).__name__}, expected a list of [x, y] {kind}s in metres")
    try:
        points = list(raw)
    except TypeError:  # an array without dimensions
        raise RoadError(f"a road is a single value, expected a list of [x, y] {kind}s in metres") from None
    if not minimum <= len(points) <= MAX_POINTS:
        raise RoadError(f"a road has {len(points)} {kind}s, expected {minimum} to {MAX_POINTS}")
    pairs = tuple(_parse_point(point, f"{kind} {index}") for index, point in enumerate(points))
    for index, ((x0, y0), (x1, y1)) in enumerate(pairwise(pairs)):
        if abs(x1 - x0) < MIN_SPACING and abs(y1 - y0) < MIN_SPACING:
            raise RoadError(f"{kind}s {index} and {index + 1} coincide: remove one of them")
    return pairs


def _parse_point(point: Any, name: str) -> tuple[float, float]:
    """Convert one point; adding zero turns -0.0 into 0.0, so that equal points have equal bytes."""
    try:
        x, y = point
        pair = (float(x) + 0.0, float(y) + 0.0)
    except (TypeError, ValueError, OverflowError):
        raise RoadError(f"{name} is {abbreviated(point)}, expected two numbers [x, y]") from None
    if isinstance(point, str | dict) or any(isinstance(v, str | bytes | bool | np.bool_) for v in (x, y)):
        raise RoadError(f"{name} is {abbreviated(point)}, expected two numbers [x, y]")
    if not all(abs(v) <= _MAX_COORDINATE for v in pair):
        raise RoadError(f"{name} is {abbreviated(point)}, expected finite metres up to {_MAX_COORDINATE:g}")
    return pair
