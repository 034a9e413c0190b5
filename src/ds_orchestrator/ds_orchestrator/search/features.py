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
from functools import cache, partial
from operator import attrgetter
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ds_base.errors import InputError
from ds_base.extension import installed, is_extension, load_extension, load_installed
from ds_road import Road
from ds_road.geometry import direction_coverage, largest_lane_curvature, minimum_radius
from ds_sim.conditions.model import DEFAULT, FIELDS, Conditions, between, share_of
from ds_sim.conditions.text import format_3sf
from ds_sim.gates.gate import LEAST_CONTRAST

Cell = tuple[int, ...]
"""Cell of a feature map: one bin index per feature."""

FEET = 3.280839895
"""Feet in a metre (DeepHyperion counts radii in feet)."""


class DriveSeries(Protocol):
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
class TestedRun:
    """What features are computed from: a test, and its run on the sibling whose search generated it."""

    __test__ = False  # not a test case for pytest

    road: Road
    conditions: Conditions = DEFAULT
    drive: DriveSeries | None = None  # the run; None before it
    visible_contrast: float | None = None  # contrast of the lines at the start (`Gate`); None if it was not measured
    maxitwo_compatible: bool = False  # count turns as the authors' package does


@dataclass(frozen=True, kw_only=True)
class Bins:
    """Numbered intervals of a feature's values."""

    per_unit: int = 1  # bins of width 1 in one unit of the axis title
    size: float | None = None  # size of a bin of an imported column, in its unit; None for any other feature
    # Converts a value to bins of width 1, if they are not of equal size.
    position: Callable[[float], float] | None = None
    # Converts such a position back to the unit of the title; None for bins of equal size.
    edge: Callable[[int], float] | None = None
    width: int = 1  # number of bins joined into one

    def number(self, value: float) -> int:
        """Compute the bin of a value."""
        return int(self.per_unit * value if self.position is None else self.position(value)) // self.width

    def label(self, bin_: int) -> str:
        """Format the lower edge of a bin in the unit of the title."""
        begin = bin_ * self.width
        if self.size is not None:
            return format_3sf(begin * self.size)
        if self.edge is not None:
            return format_3sf(self.edge(begin))
        return str(begin) if self.per_unit == 1 else f"{begin / self.per_unit:.2f}"


@dataclass(frozen=True)
class Feature:
    """One axis of a feature map."""

    name: str  # name in configurations and results
    title: str  # axis title, with the unit
    # Computes the feature; None if it needs a run, a gate or a condition's value that is missing.
    value: Callable[[TestedRun], float | None]
    bins: Bins = Bins()  # intervals into which its values fall

    @property
    def axis(self) -> str:
        """Name in files of maps, with the size of the bins of an imported column."""
        return self.name if self.bins.size is None else f"{self.name} in bins of {self.bins.size!r}"

    def label(self, bin_: int) -> str:
        """Format the lower edge of a bin in the unit of the title: `0.17` for curvature 17."""
        return self.bins.label(bin_)

    def bin_of(self, run: TestedRun) -> int | None:
        """Compute the bin of a test; None if it has none."""
        value = self.value(run)
        return None if value is None else self.bins.number(value)


def _turns_count(run: TestedRun) -> float:
    return run.road.turns_count_maxitwo if run.maxitwo_compatible else run.road.turns_count


def _steering_deviation(run: TestedRun) -> float | None:
    """Population standard deviation of the steering commands (maxitwo)."""
    if run.drive is None:
        return None
    return float(np.std(run.drive.steering)) if len(run.drive.steering) else 0.0


def _mean_lateral_position(run: TestedRun) -> float | None:
    """Mean absolute lateral position, m; DeepHyperion takes the distance to the lane's edge, 2 m minus this."""
    if run.drive is None:
        return None
    lateral = run.drive.trajectory[:, 4]
    return math.fsum(np.abs(lateral)) / len(lateral) if len(lateral) else 0.0


_right, _left = attrgetter("lane_curvature_max_right"), attrgetter("lane_curvature_max_left")
_in_hundredths = partial(Feature, bins=Bins(per_unit=100))
"""Makes a feature with bins of 0.01; those of all curvatures are equal, so that the axes compare."""
_ALL = (
    Feature("turns_count", "turns count", _turns_count),
    _in_hundredths("curvature", "curvature, 1/m", lambda run: run.road.curvature),
    _in_hundredths("steering_deviation", "steering deviation", _steering_deviation),
    _in_hundredths("mean_lateral_position", "mean lateral position, m", _mean_lateral_position),
    Feature("direction_coverage", "direction coverage, %", lambda run: 100 * direction_coverage(run.road.points)),
    Feature("minimum_radius", "minimum radius, feet", lambda run: FEET * minimum_radius(run.road.points)),
    _in_hundredths("lane_curvature", "lane curvature, 1/m", lambda run: max(_right(run.road), _left(run.road))),
    _in_hundredths("lane_curvature_max_right", "lane curvature to the right, 1/m", lambda run: _right(run.road)),
    _in_hundredths("lane_curvature_max_left", "lane curvature to the left, 1/m", lambda run: _left(run.road)),
    _in_hundredths(
        "other_lane_curvature_max_right",
        "other lane's curvature to the right, 1/m",
        lambda run: largest_lane_curvature(run.road.other_lane_centre, "right"),
    ),
    _in_hundredths(
        "other_lane_curvature_max_left",
        "other lane's curvature to the left, 1/m",
        lambda run: largest_lane_curvature(run.road.other_lane_centre, "left"),
    ),
    # DeepHyperion's segment count is the number of turns: its code returns the runs that are not straight.
    Feature("segment_count", "segment count", _turns_count),
)


def _of_condition(name: str) -> Feature:
    """Axis of an operating condition: `CONDITION_BINS` bins over its whole range, of equal size on its scale.

    A condition without a value, as each simulator has it, has no bin.
    """
    condition = FIELDS[name]
    low, high = condition.low, condition.high

    def position(value: float) -> float:
        return min(CONDITION_BINS * share_of(name, low, high, value) + _ROUNDING, CONDITION_BINS - 1)

    return Feature(
        name=name,
        title=f"{name.replace('_', ' ')}{f', {condition.unit}' if condition.unit else ''}",
        value=lambda run: getattr(run.conditions, name),
        bins=Bins(position=position, edge=lambda bin_: between(name, low, high, min(bin_ / CONDITION_BINS, 1.0))),
    )


VISIBLE_CONTRAST = "visible_contrast"
"""Feature that needs the visibility gate; bins double, as contrast is noticed in ratios (Weber)."""
CONDITION_BINS = 10
"""Bins of a condition's range; chosen: as many as the curvature usually fills."""
_ROUNDING = 1e-9
"""Added before rounding down, so that the lower edge of a bin lies in it."""
_MEASURED = Feature(
    name=VISIBLE_CONTRAST,
    title="measured line contrast",
    value=lambda run: run.visible_contrast,
    # Doublings of the threshold at which lines become invisible; 0 below one, and for invisible lines.
    bins=Bins(
        position=lambda contrast: math.log2(contrast / LEAST_CONTRAST) if contrast > LEAST_CONTRAST else 0.0,
        edge=lambda bin_: LEAST_CONTRAST * 2.0**bin_,
    ),
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
    """Look up a feature by name; `minimum_radius:20` joins twenty bins.

    Args:
        name: key of `FEATURES`, entry point of an installed package in the group `digital_siblings.features`, or
            `module:NAME`, a `Feature`.

    Raises:
        FeatureError: the name is unknown, or the width is not a whole number of at least 1.
        ds_base.extension.ExtensionError: a feature of others cannot be loaded.

    Examples:
        >>> from ds_orchestrator import feature_of
        >>> feature_of("minimum_radius:20").title
        'minimum radius, feet'
    """
    base, plain = base_of(name), name.partition(":")[0]
    names = [*FEATURES, *installed("features")]
    if base not in names and plain in names:
        raise FeatureError(f"feature {name!r}: expected a whole number of bins, at least 1, as in {plain}:20")
    width = int(name[len(base) + 1 :] or 1)
    if width < 1:
        raise FeatureError(f"feature {name!r}: expected a whole number of bins, at least 1, as in {base}:20")
    if base in FEATURES:
        feature = FEATURES[base]
    elif base in names:
        feature = load_installed(base, "features", Feature, "feature")
    elif is_extension(base):
        feature = load_extension(base, Feature, "feature")
    else:
        raise FeatureError(f"unknown feature {name!r}: expected one of {', '.join(names)}, or module:NAME")
    return replace(feature, name=name, bins=replace(feature.bins, width=width))


DEFAULT_AXES = tuple(map(feature_of, DEFAULT_FEATURES))
"""The features of `DEFAULT_FEATURES`."""


def column_axis(column: str, width: float) -> Feature:
    """Make the axis of a map over a column of imported outcomes, in bins of a width."""
    return Feature(name=column, title=column, value=lambda run: None, bins=Bins(size=width))


def cell_of(
    road: Road,
    drive: DriveSeries | None = None,
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
    run = TestedRun(
        road=road,
        conditions=conditions,
        drive=drive,
        visible_contrast=visible_contrast,
        maxitwo_compatible=maxitwo_compatible,
    )
    bins = [bin_ for name in features if (bin_ := feature_of(name).bin_of(run)) is not None]
    return tuple(bins) if len(bins) == len(features) else None
