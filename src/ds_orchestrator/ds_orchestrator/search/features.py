# SPDX-License-Identifier: Apache-2.0
"""Features that span a feature map, by name, and the cell of a test (paper 3.3).

Some features depend on the road or the conditions alone, others on a run, which differs between simulators. The union
of two maps needs the same tests in the same cells (paper 3.4), so a test has one cell on all simulators: that of its
run on the sibling whose search generated it. A test without that run has no cell yet and enters no map.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ds_base.errors import InputError
from ds_base.extension import is_extension, load_extension
from ds_road import Road
from ds_road.geometry import direction_coverage, largest_lane_curvature, minimum_radius
from ds_sim.conditions.model import DEFAULT, FIELDS, Conditions
from ds_sim.conditions.scales import between, share_of
from ds_sim.conditions.text import three_digits
from ds_sim.gates.gate import LEAST_CONTRAST

Cell = tuple[int, ...]
"""Cell of a feature map: one bin index per feature."""

FEET = 3.280839895
"""Feet in a metre (DeepHyperion counts radii in feet)."""


class Drive(Protocol):
    """Data of a run from which features are computed."""

    @property
    def steering(self) -> NDArray[np.float64]:
        """(steps,) steering commands in [-1, 1]."""
        ...

    @property
    def trajectory(self) -> NDArray[np.float64]:
        """(steps + 1, 5): x, y, yaw, speed, lateral position."""
        ...


@dataclass(frozen=True, kw_only=True)
class Feature:
    """One axis of a feature map.

    Attributes:
        name: name in configurations and results.
        title: axis title, with the unit.
        unit: size of one bin of width 1, in the unit of the title.
        of_road: computes the bin of a road; None for a feature of the run.
        of_road_maxitwo: the same as the authors' package computes it, where that differs.
        of_run: computes the bin of a run; None for a feature of the road.
        of_conditions: computes the bin of operating conditions; None for any other feature.
        of_visible_contrast: computes the bin of the lines' contrast, as the visibility gate measures it on the sibling
            whose search generated the test; None for any other feature.
        edge: computes the lower edge of a bin of width 1; None where bins are of equal size `unit`.
        width: number of bins joined into one.
    """

    name: str
    title: str
    unit: float = 1.0
    of_road: Callable[[Road], int] | None = None
    of_road_maxitwo: Callable[[Road], int] | None = None
    of_run: Callable[[Drive], int] | None = None
    of_conditions: Callable[[Conditions], int | None] | None = None
    of_visible_contrast: Callable[[float], int] | None = None
    edge: Callable[[int], float] | None = None
    width: int = 1

    def label(self, bin_: int) -> str:
        """Format the lower edge of a bin in the unit of the title: `0.17` for curvature 17."""
        begin = bin_ * self.width
        if self.edge is not None:
            return three_digits(self.edge(begin))
        return str(begin) if self.unit == 1.0 else f"{begin * self.unit:.2f}"

    def bin_of(
        self,
        road: Road,
        drive: Drive | None,
        *,
        maxitwo_compatible: bool,
        conditions: Conditions = DEFAULT,
        visible_contrast: float | None = None,
    ) -> int | None:
        """Compute the bin of a test; None if the feature needs a run, a gate or a condition's value that is missing."""
        if self.of_visible_contrast is not None:
            return None if visible_contrast is None else self.of_visible_contrast(visible_contrast) // self.width
        if self.of_conditions is not None:
            bin_ = self.of_conditions(conditions)
            return None if bin_ is None else bin_ // self.width
        of_road = self.of_road_maxitwo if maxitwo_compatible and self.of_road_maxitwo else self.of_road
        if of_road is not None:
            return of_road(road) // self.width
        return None if drive is None or self.of_run is None else self.of_run(drive) // self.width


def _steering_deviation(drive: Drive) -> int:
    """int(100 x population standard deviation of the steering commands) (maxitwo)."""
    return int(100 * float(np.std(drive.steering))) if len(drive.steering) else 0


def _mean_lateral_position(drive: Drive) -> int:
    """int(100 x mean absolute lateral position); DeepHyperion takes the distance to the lane's edge, 200 minus this."""
    lateral = drive.trajectory[:, 4]
    return int(100 * math.fsum(np.abs(lateral)) / len(lateral)) if len(lateral) else 0


_ALL = (
    Feature(
        name="turns_count",
        title="turns count",
        of_road=lambda road: road.turns_count,
        of_road_maxitwo=lambda road: road.turns_count_maxitwo,
    ),
    Feature(name="curvature", title="curvature, 1/m", unit=0.01, of_road=lambda road: road.curvature_bin),
    Feature(name="steering_deviation", title="steering deviation", unit=0.01, of_run=_steering_deviation),
    Feature(name="mean_lateral_position", title="mean lateral position, m", unit=0.01, of_run=_mean_lateral_position),
    Feature(
        name="direction_coverage",
        title="direction coverage, %",
        of_road=lambda road: int(100 * direction_coverage(road.points)),
    ),
    Feature(
        name="minimum_radius",
        title="minimum radius, feet",
        of_road=lambda road: int(FEET * minimum_radius(road.points)),
    ),
    # Bins as wide as those of the curvature, so that the axes compare.
    Feature(
        name="lane_curvature",
        title="lane curvature, 1/m",
        unit=0.01,
        of_road=lambda road: int(100 * max(road.lane_curvature_max_right, road.lane_curvature_max_left)),
    ),
    Feature(
        name="lane_curvature_max_right",
        title="lane curvature to the right, 1/m",
        unit=0.01,
        of_road=lambda road: int(100 * road.lane_curvature_max_right),
    ),
    Feature(
        name="lane_curvature_max_left",
        title="lane curvature to the left, 1/m",
        unit=0.01,
        of_road=lambda road: int(100 * road.lane_curvature_max_left),
    ),
    Feature(
        name="other_lane_curvature_max_right",
        title="other lane's curvature to the right, 1/m",
        unit=0.01,
        of_road=lambda road: int(100 * largest_lane_curvature(road.other_lane_centre, "right")),
    ),
    Feature(
        name="other_lane_curvature_max_left",
        title="other lane's curvature to the left, 1/m",
        unit=0.01,
        of_road=lambda road: int(100 * largest_lane_curvature(road.other_lane_centre, "left")),
    ),
    # DeepHyperion's segment count is the number of turns: its code returns the runs that are not straight.
    Feature(
        name="segment_count",
        title="segment count",
        of_road=lambda road: road.turns_count,
        of_road_maxitwo=lambda road: road.turns_count_maxitwo,
    ),
)


def _of_condition(name: str) -> Feature:
    """Axis of an operating condition: `CONDITION_BINS` bins over its whole range, of equal size on its scale."""
    condition = FIELDS[name]

    def bin_of(conditions: Conditions) -> int | None:
        value = getattr(conditions, name)
        if value is None:  # as the simulator has it, which differs between simulators
            return None
        share = share_of(name, condition.low, condition.high, value)
        return min(int(CONDITION_BINS * share + _ROUNDING), CONDITION_BINS - 1)

    return Feature(
        name=name,
        title=f"{name.replace('_', ' ')}{f', {condition.unit}' if condition.unit else ''}",
        of_conditions=bin_of,
        edge=lambda bin_: between(name, condition.low, condition.high, min(bin_ / CONDITION_BINS, 1.0)),
    )


def _measured_contrast_bin(contrast: float) -> int:
    """Doublings of the threshold at which lines become invisible; 0 below one, and for invisible lines."""
    return int(math.log2(contrast / LEAST_CONTRAST)) if contrast > LEAST_CONTRAST else 0


VISIBLE_CONTRAST = "visible_contrast"
"""Feature that needs the visibility gate; bins double, as contrast is noticed in ratios (Weber)."""
CONDITION_BINS = 10
"""Bins of a condition's range; chosen: as many as the curvature usually fills."""
_ROUNDING = 1e-9
"""Added before rounding down, so that the lower edge of a bin lies in it."""
_MEASURED = Feature(
    name=VISIBLE_CONTRAST,
    title="measured line contrast",
    of_visible_contrast=_measured_contrast_bin,
    edge=lambda bin_: LEAST_CONTRAST * 2.0**bin_,
)
FEATURES: Mapping[str, Feature] = {feature.name: feature for feature in (*_ALL, _MEASURED, *map(_of_condition, FIELDS))}
"""Every feature by name: DeepHyperion's seven (paper 3.3 uses the first two), the curvature of each lane, the contrast
of the lines in the image, and every operating condition."""
DEFAULT_FEATURES = ("turns_count", "curvature")
"""The paper's (3.3)."""


class FeatureError(InputError):
    """Unknown feature name, or invalid bin width."""


def base_of(name: str) -> str:
    """Name of a feature without the width of its bins: `minimum_radius` for `minimum_radius:20`."""
    plain, _, ending = name.rpartition(":")
    return plain if plain and ending.isdecimal() else name


@cache
def feature_of(name: str) -> Feature:
    """Look up a feature: a key of `FEATURES`, or `module:NAME`, a `Feature`; `minimum_radius:20` joins twenty bins.

    Raises:
        FeatureError: the name is unknown, or the width is not a whole number of at least 1.
        ds_base.extension.ExtensionError: the user's own feature cannot be loaded.

    Examples:
        >>> from ds_orchestrator import feature_of
        >>> feature_of("minimum_radius:20").title
        'minimum radius, feet'
    """
    if _IN_BINS in name:
        title, _, size = name.rpartition(_IN_BINS)
        return Feature(name=name, title=title, edge=lambda bin_: bin_ * float(size))
    base = base_of(name)
    known = name.partition(":")[0]
    if base not in FEATURES and known in FEATURES:
        raise FeatureError(f"feature {name!r}: expected a whole number of bins, at least 1, as in {known}:20")
    if base not in FEATURES and not is_extension(base):
        raise FeatureError(f"unknown feature {name!r}: expected one of {', '.join(FEATURES)}, or module:NAME")
    width = int(name[len(base) + 1 :] or 1)
    if width < 1:
        raise FeatureError(f"feature {name!r}: expected a whole number of bins, at least 1, as in {base}:20")
    feature = FEATURES[base] if base in FEATURES else load_extension(base, Feature, "feature")
    return replace(feature, name=name, width=width)


_IN_BINS = " in bins of "
"""Part of the name of an axis of imported outcomes."""


def column_axis(column: str, width: float) -> str:
    """Name the axis of a map over a column of imported outcomes, in bins of a width, as `feature_of` takes it."""
    return f"{column}{_IN_BINS}{width!r}"


def short_name(axis: str) -> str:
    """Name an axis without the width of its bins."""
    return axis.partition(_IN_BINS)[0]


def cell_of(
    road: Road,
    drive: Drive | None = None,
    *,
    features: Sequence[str] = DEFAULT_FEATURES,
    maxitwo_compatible: bool = False,
    conditions: Conditions = DEFAULT,
    visible_contrast: float | None = None,
) -> Cell | None:
    """Compute the cell of a test.

    Args:
        road: road of the test.
        drive: run on the sibling whose search generated the test; only features of the run need it.
        features: names of the features; see `feature_of`.
        maxitwo_compatible: count turns as the authors' package does.
        conditions: operating conditions of the test.
        visible_contrast: contrast of the lines at the start on the same sibling (`Gate`), if it was measured.

    Returns:
        One bin per feature, or None if a feature needs the run or the contrast and there is none.

    Examples:
        >>> from ds_orchestrator import cell_of
        >>> from ds_road import Road
        >>> road = Road([(125, 0), (125, 25), (125, 50), (140, 75), (165, 90)])
        >>> cell_of(road)
        (1, 3)
        >>> cell_of(road, features=["turns_count", "minimum_radius:20"])
        (1, 4)
    """
    cell = []
    for name in features:
        bin_ = feature_of(name).bin_of(
            road, drive, maxitwo_compatible=maxitwo_compatible, conditions=conditions, visible_contrast=visible_contrast
        )
        if bin_ is None:
            return None
        cell.append(bin_)
    return tuple(cell)
