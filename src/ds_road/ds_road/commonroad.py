# SPDX-License-Identifier: Apache-2.0
"""Reads roads from CommonRoad scenarios, XML formats 2018b and 2020a (Althoff, Koschi and Manzinger 2017)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from xml.etree.ElementTree import Element

import numpy as np
import shapely
from numpy.typing import NDArray

from ds_road.geometry import apart
from ds_road.road import MAX_POINTS, MIN_SPACING, Road, RoadError, Side

READABLE = ("2018b", "2020a")
"""Versions whose lanelets are written alike."""
WIDTH_SPREAD = 0.5
"""m by which the width of an imported lane may vary, as roads have one width here; chosen: an eighth of the usual."""
MOST_LANELETS = 10_000
"""Lanelets of a file; chosen: a town's, read within seconds."""
_NEAR = 0.01
"""m from a lanelet within which a planning problem starts in it."""


@dataclass(frozen=True)
class Lanelet:
    """A lanelet: bounds as (n, 2) points in m, in driving order, and its neighbours' ids."""

    left: NDArray[np.float64]
    right: NDArray[np.float64]
    predecessors: tuple[str, ...]
    successors: tuple[str, ...]
    oncoming_left: bool
    oncoming_right: bool


def read_commonroad(root: Element) -> Road:
    """Road along lanelets, from the planning problem's initial position on, or from the first one without predecessor.

    Where a lanelet has several successors the first one is followed. The centre line is the bound on the side of the
    oncoming lanelet, or the left one; traffic signs, obstacles and other lanelets are ignored. RoadError if there are
    no such lanelets, or their width varies.
    """
    version = root.get("commonRoadVersion", "none")
    if version not in READABLE:
        raise RoadError(f"CommonRoad version {version[:20]}, expected {' or '.join(READABLE)}")
    elements = [element for element in root.iter("lanelet") if element.get("id")]
    if not elements:
        raise RoadError("a CommonRoad file without lanelets: expected at least one")
    if len(elements) > MOST_LANELETS:
        raise RoadError(f"{len(elements)} lanelets, expected at most {MOST_LANELETS}: divide the file")
    lanelets = {element.get("id", ""): _read_lanelet(element) for element in elements}
    chain = _chain(lanelets, _start(root, lanelets))
    left, right = (np.vstack([getattr(lanelet, side) for lanelet in chain]) for side in ("left", "right"))
    widths = np.hypot(*(left - right).T)
    lane: Side = "left" if chain[0].oncoming_right and not chain[0].oncoming_left else "right"
    points = apart(left if lane == "right" else right, math.sqrt(2.0) * MIN_SPACING)
    return Road.from_road_points(points, lane_width=constant_width(widths), lane=lane)


def constant_width(widths: NDArray[np.float64]) -> float:
    """Median of a lane's widths, m, which may vary by `WIDTH_SPREAD`."""
    if not len(widths) or not np.isfinite(widths).all() or np.ptp(widths) > WIDTH_SPREAD:
        low, high = (widths.min(), widths.max()) if len(widths) else (math.nan, math.nan)
        raise RoadError(f"the lane is {low:.2f} to {high:.2f} m wide: expected widths within {WIDTH_SPREAD:g} m")
    return round(float(np.median(widths)), 6)


def _start(root: Element, lanelets: dict[str, Lanelet]) -> str:
    point = root.find("planningProblem/initialState/position/point")
    if point is not None:
        position = shapely.Point(_coordinates(point))
        for number, lanelet in lanelets.items():
            # Not by a buffer around it, which takes minutes and gigabytes where the bounds cross each other.
            if shapely.Polygon(np.vstack((lanelet.left, lanelet.right[::-1]))).distance(position) < _NEAR:
                return number
        raise RoadError("the planning problem starts outside of all lanelets")
    return next((number for number, lanelet in lanelets.items() if not lanelet.predecessors), next(iter(lanelets)))


def _chain(lanelets: dict[str, Lanelet], first: str) -> list[Lanelet]:
    numbers = {first: None}
    while following := lanelets[next(reversed(numbers))].successors:
        if following[0] in numbers or following[0] not in lanelets:
            break
        numbers[following[0]] = None
    return [lanelets[number] for number in numbers]


def _read_lanelet(element: Element) -> Lanelet:
    left, right = (
        np.array([_coordinates(point) for point in element.findall(f"{tag}/point")])
        for tag in ("leftBound", "rightBound")
    )
    if left.shape != right.shape or not 2 <= len(left) <= MAX_POINTS:
        raise RoadError(
            f"lanelet {element.get('id', '')[:20]} has {len(left)} points on its left and {len(right)} on its right: "
            f"expected as many, 2 to {MAX_POINTS}"
        )
    oncoming = [
        (neighbour := element.find(tag)) is not None and neighbour.get("drivingDir") == "opposite"
        for tag in ("adjacentLeft", "adjacentRight")
    ]
    links = (tuple(link.get("ref", "") for link in element.findall(tag)) for tag in ("predecessor", "successor"))
    predecessors, successors = links
    return Lanelet(left, right, predecessors, successors, *oncoming)


def _coordinates(point: Element) -> tuple[float, float]:
    try:
        x, y = (float(point.findtext(axis, "")) for axis in "xy")
    except ValueError:
        raise RoadError("a point has no x and y: expected two numbers") from None
    if not (math.isfinite(x) and math.isfinite(y)):
        raise RoadError("a point is not finite: expected metres")
    return x, y
