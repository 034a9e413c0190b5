"""The road: an immutable value made of control points, with everything that follows from them."""

from __future__ import annotations

import hashlib
import reprlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import pairwise
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
MIN_SPACING = 1e-3
"""m between two neighbours at least; chosen: nearer ones have no direction that floating point can tell."""
_LARGEST = 1e6


class RoadError(ValueError):
    """Something of which no road can be made, or a road on which nobody can drive."""


@dataclass(frozen=True, init=False, repr=False)
class Road:
    """A two-lane road through control points (paper 3.1.1), driven in the right lane.

    The first and the last control point only give the spline its direction: the road starts at the second and ends
    at the second last. Roads of equal content are equal, and have the same `road_id`.

    Args:
        control_points: (n, 2) numbers, m, 4 <= n <= 1000.
        lane_width: m, of each of the two lanes.
        maxitwo_compatible: the centre line as maxitwo has it for mutants: the spline ignores the first control point,
            so that the road starts at the third (n >= 5). It does not touch the way turns are counted:
            `turns_count_maxitwo` exists for every road.

    Raises:
        RoadError: not such numbers, or two neighbours less than a millimetre apart.
    """

    control_points: tuple[tuple[float, float], ...]
    lane_width: float
    maxitwo_compatible: bool
    sampled: bool
    """The control points are the centre line itself; see `from_road_points`."""

    def __init__(
        self,
        control_points: Iterable[Sequence[float]] | NDArray[np.float64],
        *,
        lane_width: float = LANE_WIDTH,
        maxitwo_compatible: bool = False,
    ) -> None:
        self._set(
            _checked(control_points, "control point", least=5 if maxitwo_compatible else 4),
            lane_width,
            maxitwo_compatible,
            False,
        )

    @classmethod
    def from_road_points(
        cls, points: Iterable[Sequence[float]] | NDArray[np.float64], *, lane_width: float = LANE_WIDTH
    ) -> Road:
        """A road whose centre line is these points as they are, the way other tools of this field exchange roads.

        Its `control_points` are the points, and `sampled` is true: no spline is laid through them.

        Args:
            points: (n, 2) numbers, m, 2 <= n <= 1000, in driving order.
            lane_width: m, of each of the two lanes.

        Raises:
            RoadError: not such numbers, or two neighbours less than a millimetre apart.
        """
        road = cls.__new__(cls)
        road._set(_checked(points, "road point", least=2), lane_width, False, True)
        return road

    def _set(
        self,
        control_points: tuple[tuple[float, float], ...],
        lane_width: float,
        maxitwo_compatible: bool,
        sampled: bool,
    ) -> None:
        """Fill in the fields, which nobody can change afterwards."""
        if isinstance(lane_width, str | bool) or not isinstance(lane_width, int | float) or not 1 <= lane_width <= 20:
            raise RoadError(f"lane width is {shown(lane_width)}, expected 1 to 20 metres")
        values = (control_points, float(lane_width), bool(maxitwo_compatible), sampled)
        for field, value in zip(fields(self), values, strict=True):
            object.__setattr__(self, field.name, value)

    def __getstate__(self) -> dict[str, Any]:
        """What makes the road, without what follows from it."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def __repr__(self) -> str:
        kind = "road points" if self.sampled else "control points"
        quirk = ", maxitwo-compatible" if self.maxitwo_compatible else ""
        return f"Road({self.road_id}, {len(self.control_points)} {kind}{quirk})"

    @cached_property
    def road_id(self) -> str:
        """Twelve hexadecimal digits that stand for the control points, and for how the road is made of them."""
        content = hashlib.sha256(np.asarray(self.control_points, dtype="<f8").tobytes())
        if self.sampled or self.maxitwo_compatible or self.lane_width != LANE_WIDTH:
            content.update(f"{self.lane_width} {self.maxitwo_compatible} {self.sampled}".encode())
        return content.hexdigest()[:12]

    @cached_property
    def points(self) -> NDArray[np.float64]:
        """Samples of the centre line, (20 + 19 (n - 4), 2), m.

        n is the number of control points, minus one on a maxitwo-compatible road, whose spline ignores the first.
        """
        given = np.array(self.control_points)
        if self.sampled:
            return _frozen(given)
        return _frozen(catmull_rom(given[1:] if self.maxitwo_compatible else given))

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
    def turns_count_maxitwo(self) -> int:
        """Number of turns as the authors' package counts them."""
        return turns_count(self.points, maxitwo_compatible=True)

    @cached_property
    def validity(self) -> Validity:
        """Whether the road can be driven (paper 3.1.3)."""
        return check_surface(self.left_edge, self.right_edge)

    def reversed(self) -> Road:
        """The same centre line driven the other way.

        The first control point of a maxitwo-compatible road, which its spline ignores, is dropped.
        """
        if self.sampled:
            return Road.from_road_points(self.control_points[::-1], lane_width=self.lane_width)
        used = self.control_points[1:] if self.maxitwo_compatible else self.control_points
        return Road(used[::-1], lane_width=self.lane_width)


def shown(value: Any) -> str:
    """Some value in an error's one line, cut to what fits."""
    try:
        return reprlib.repr(value)
    except ValueError:  # an integer of thousands of digits
        return f"a huge {type(value).__name__}"


def _frozen(array: NDArray[np.float64]) -> NDArray[np.float64]:
    array.setflags(write=False)
    return array


def _checked(raw: Any, what: str, *, least: int) -> tuple[tuple[float, float], ...]:
    """Points as pairs of finite floats."""
    if isinstance(raw, str | bytes | dict) or not isinstance(raw, Iterable):
        raise RoadError(f"a road is {type(raw).__name__}, expected a list of [x, y] {what}s in metres")
    try:
        points = list(raw)
    except TypeError:  # an array without a dimension
        raise RoadError(f"a road is a single value, expected a list of [x, y] {what}s in metres") from None
    if not least <= len(points) <= MAX_POINTS:
        raise RoadError(f"a road has {len(points)} {what}s, expected {least} to {MAX_POINTS}")
    pairs = tuple(_pair(point, f"{what} {index}") for index, point in enumerate(points))
    for index, ((x0, y0), (x1, y1)) in enumerate(pairwise(pairs)):
        if abs(x1 - x0) < MIN_SPACING and abs(y1 - y0) < MIN_SPACING:
            raise RoadError(f"{what}s {index} and {index + 1} are the same place: remove one of them")
    return pairs


def _pair(point: Any, name: str) -> tuple[float, float]:
    """One point; adding zero turns -0.0 into 0.0, so that equal points are equal bytes."""
    try:
        x, y = point
        pair = (float(x) + 0.0, float(y) + 0.0)
    except (TypeError, ValueError, OverflowError):
        raise RoadError(f"{name} is {shown(point)}, expected two numbers [x, y]") from None
    if isinstance(point, str | dict) or any(isinstance(v, str | bytes | bool | np.bool_) for v in (x, y)):
        raise RoadError(f"{name} is {shown(point)}, expected two numbers [x, y]")
    if not all(abs(v) <= _LARGEST for v in pair):
        raise RoadError(f"{name} is {shown(point)}, expected finite metres up to {_LARGEST:g}")
    return pair
