# SPDX-License-Identifier: Apache-2.0
"""Writes and reads roads as CommonRoad scenarios, XML format 2020a (Althoff, Koschi and Manzinger 2017).

A road is two lanelets: 1 is the driven lane, 2 the oncoming one. A CommonRoad scenario needs a planning problem: from
rest at the start of the driven lane to its end, within the 2,000 frames of 1/20 s that a run may take.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
import shapely
from numpy.typing import NDArray

from ds_road.geometry import apart
from ds_road.road import MAX_POINTS, MIN_SPACING, Road, RoadError, Side

VERSION = "2020a"
READABLE = ("2018b", "2020a")
"""Versions whose lanelets are written alike."""
WIDTH_SPREAD = 0.5
"""m by which the width of an imported lane may vary, as roads have one width here; chosen: an eighth of the usual."""
MOST_LANELETS = 10_000
"""Lanelets of a file; chosen: a town's, read within seconds."""
_NEAR = 0.01
"""m from a lanelet within which a planning problem starts in it."""
_DATE = "1970-01-01"
"""Of the file: the schema wants one, and the same road gives the same bytes."""
_TIME_STEP = "0.05"
_MOST_STEPS = "2000"
_GOAL_LENGTH = 5.0
"""m of the lane's end in which the goal is reached; chosen: a car's length."""
_START = 0.1
"""m from the lane's beginning to the initial position, which has to lie inside of the lanelet."""
_DRIVEN, _ONCOMING = "1", "2"


@dataclass(frozen=True)
class Lanelet:
    """A lanelet: bounds as (n, 2) points in m, in driving order, and its neighbours' ids."""

    left: NDArray[np.float64]
    right: NDArray[np.float64]
    predecessors: tuple[str, ...]
    successors: tuple[str, ...]
    oncoming_left: bool
    oncoming_right: bool


def commonroad(road: Road, name: str) -> str:
    """A road as a CommonRoad scenario, XML."""
    root = Element(
        "commonRoad",
        commonRoadVersion=VERSION,
        benchmarkID=f"ZAM_{_letters(name)}-1_1_T-1",
        date=_DATE,
        author="Digital Siblings",
        affiliation="",
        source=f"road {road.road_id}",
        timeStepSize=_TIME_STEP,
    )
    location = add(root, "location")
    for tag, unknown in (("geoNameId", "-999"), ("gpsLatitude", "999"), ("gpsLongitude", "999")):
        add(location, tag, unknown)
    tags = add(root, "scenarioTags")
    for tag in ("no_oncoming_traffic", "rural", "simulated", "two_lane"):
        add(tags, tag)
    if road.lane not in ("right", "left"):
        raise RoadError(f"road {road.road_id} is driven in its {road.lane} lane: CommonRoad has right and left ones")
    right = road.lane == "right"
    centre, outer = road.points, road.right_edge if right else road.left_edge
    other = (road.left_edge if right else road.right_edge)[::-1]
    side = "adjacentLeft" if right else "adjacentRight"
    _lanelet(root, _DRIVEN, (centre, outer) if right else (outer, centre), side, _ONCOMING)
    _lanelet(root, _ONCOMING, (centre[::-1], other) if right else (other, centre[::-1]), side, _DRIVEN)
    _planning_problem(root, road)
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def read_commonroad(root: Element) -> Road:
    """Road along lanelets, from the planning problem's initial position on, or from the first one without predecessor.

    Where a lanelet has several successors the first one is followed. The centre line is the bound on the side of the
    oncoming lanelet, or the left one; traffic signs, obstacles and other lanelets are ignored.

    Raises:
        RoadError: the file has no such lanelets, or their width varies.
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
    """Median of a lane's widths, m.

    Raises:
        RoadError: they vary by more than `WIDTH_SPREAD`.
    """
    if not len(widths) or not np.isfinite(widths).all() or np.ptp(widths) > WIDTH_SPREAD:
        low, high = (widths.min(), widths.max()) if len(widths) else (math.nan, math.nan)
        raise RoadError(f"the lane is {low:.2f} to {high:.2f} m wide: expected widths within {WIDTH_SPREAD:g} m")
    return round(float(np.median(widths)), 6)


def _lanelet(
    root: Element, number: str, bounds: tuple[NDArray[np.float64], NDArray[np.float64]], side: str, neighbour: str
) -> None:
    lanelet = add(root, "lanelet", id=number)
    for tag, points in zip(("leftBound", "rightBound"), bounds, strict=True):
        bound = add(lanelet, tag)
        for point in points:
            _point(bound, point)
        add(bound, "lineMarking", "solid")  # paper 3.1.2: all three lines are
    add(lanelet, side, ref=neighbour, drivingDir="opposite")
    add(lanelet, "laneletType", "country")
    add(lanelet, "userOneWay", "vehicle")


def _planning_problem(root: Element, road: Road) -> None:
    line = road.lane_centre
    first, last = line[1] - line[0], line[-1] - line[-2]
    problem = add(root, "planningProblem", id="3")
    start = add(problem, "initialState")
    _point(add(start, "position"), line[0] + _START * first / np.hypot(*first))
    for tag, value in (("orientation", math.atan2(first[1], first[0])), ("velocity", 0.0), ("yawRate", 0.0)):
        _exact(start, tag, value)
    _exact(start, "slipAngle", 0.0)
    add(add(start, "time"), "exact", "0")
    goal = add(problem, "goalState")
    time = add(goal, "time")
    add(time, "intervalStart", "1")
    add(time, "intervalEnd", _MOST_STEPS)
    rectangle = add(add(goal, "position"), "rectangle")
    add(rectangle, "length", _decimal(_GOAL_LENGTH))
    add(rectangle, "width", _decimal(road.lane_width))
    add(rectangle, "orientation", _decimal(math.atan2(last[1], last[0])))
    centre = add(rectangle, "center")
    back = line[-1] - last / np.hypot(*last) * _GOAL_LENGTH / 2
    for axis, value in zip("xy", back, strict=True):
        add(centre, axis, _decimal(value))


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


def add(parent: Element, tag: str, text: str | None = None, **attributes: str | float) -> Element:
    """Append an element; numbers are written so that every bit comes back."""
    texts = {key: value if isinstance(value, str) else repr(float(value)) for key, value in attributes.items()}
    element = ElementTree.SubElement(parent, tag, texts)
    element.text = text
    return element


def _point(parent: Element, point: NDArray[np.float64]) -> None:
    element = add(parent, "point")
    for axis, value in zip("xy", point, strict=True):
        add(element, axis, _decimal(value))


def _exact(parent: Element, tag: str, value: float) -> None:
    add(add(parent, tag), "exact", _decimal(value))


def _decimal(value: float) -> str:
    """All digits, without the exponent that xs:decimal forbids."""
    return np.format_float_positional(value, trim="0")


def _letters(name: str) -> str:
    """Name of a scene, of letters and digits."""
    return re.sub(r"[^A-Za-z0-9]", "", name)[:60] or "Road"
