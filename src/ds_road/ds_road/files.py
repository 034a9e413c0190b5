# SPDX-License-Identifier: Apache-2.0
"""Reads and writes roads as JSON.

A file holds one road or a list of roads. A road is a list of [x, y] control points in metres, in driving order, or an
object with either `control_points` or `road_points` (the centre line itself, as other tools exchange it) and, where
they differ from the defaults, `lane_width`, `maxitwo_compatible` and `lane` (`ds_road.Side`). Other keys of the object
are ignored.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

from ds_base.bounded_file import FileError, load_json, read_regular
from ds_base.folder_files import write_whole
from ds_road.road import LANE_WIDTH, Road, RoadError, Side, abbreviated

LARGEST_FILE = 16 * 2**20
"""Bytes of a road file; chosen: 40,000 roads of the usual nine points, parsed within a second."""


def road_from_json(raw: Any) -> Road:
    """Convert a JSON value to a road.

    Raises:
        RoadError: the value is not a road; one line says what is wrong and what was expected.
    """
    if not isinstance(raw, dict):
        return Road(raw)
    kinds = [kind for kind in ("control_points", "road_points") if kind in raw]
    if len(kinds) != 1:
        how_many = "both" if kinds else "neither"
        raise RoadError(f"a road has {how_many} of control_points and road_points, expected exactly one")
    lane_width, lane = raw.get("lane_width", LANE_WIDTH), raw.get("lane", "right")
    maxitwo_compatible = raw.get("maxitwo_compatible", False)
    if not isinstance(maxitwo_compatible, bool):
        raise RoadError(f"maxitwo_compatible is {abbreviated(maxitwo_compatible)}, expected true or false")
    sampled = kinds == ["road_points"]
    if sampled and maxitwo_compatible:
        raise RoadError("maxitwo_compatible is true for a road given by road_points, expected control_points")
    return Road(raw[kinds[0]], lane_width=lane_width, maxitwo_compatible=maxitwo_compatible, sampled=sampled, lane=lane)


def road_from_fields(
    points: Sequence[Sequence[float]],
    *,
    lane_width: float = 0.0,
    sampled: bool = False,
    maxitwo_compatible: bool = False,
    left_lane: bool = False,
    road_id: str = "",
) -> Road:
    """Road from the fields of a `ds_interfaces/msg/Road`.

    Args:
        points: control points, or the centre line itself if `sampled`, m.
        lane_width: m; 0 stands for the usual width.
        sampled: no spline is laid through the points.
        maxitwo_compatible: the spline ignores the first point.
        left_lane: driven in the left lane.
        road_id: of the road; tells lanes apart for which the message has no field.

    Raises:
        RoadError: the fields make no road.
    """
    road = Road(
        points,
        lane_width=lane_width or LANE_WIDTH,
        maxitwo_compatible=maxitwo_compatible,
        sampled=sampled,
        lane="left" if left_lane else "right",
    )
    if road_id in ("", road.road_id):
        return road
    others = (road.in_lane(other) for other in get_args(Side))
    return next((other for other in others if other.road_id == road_id), road)


def road_to_json(road: Road) -> list[list[float]] | dict[str, Any]:
    """Convert a road to JSON for `road_from_json`: a plain list of control points where that suffices.

    Examples:
        >>> from ds_road import Road, road_to_json
        >>> road_to_json(Road([(125, 0), (125, 25), (125, 50), (125, 75)], lane="left"))
        {'control_points': [[125.0, 0.0], [125.0, 25.0], [125.0, 50.0], [125.0, 75.0]], 'lane': 'left'}
    """
    raw = road_object(road)
    return raw["control_points"] if list(raw) == ["control_points"] else raw


def road_object(road: Road) -> dict[str, Any]:
    """Convert a road to a JSON object for `road_from_json`, to which further keys may be added."""
    raw: dict[str, Any] = {"road_points" if road.sampled else "control_points": [list(p) for p in road.control_points]}
    if road.maxitwo_compatible:
        raw["maxitwo_compatible"] = True
    if road.lane_width != LANE_WIDTH:
        raw["lane_width"] = road.lane_width
    if road.lane != "right":
        raw["lane"] = road.lane
    return raw


def parse_roads(text: str, source: str) -> list[Any]:
    """Split a JSON text of a named source into its raw roads, unchecked; a single road becomes a list of one.

    Raises:
        RoadError: the text is not JSON, or not a list.
    """
    try:
        raw = load_json(text)
    except FileError as error:
        raise RoadError(f"{source}: {error}: expected a list of roads") from None
    if _is_one_road(raw):
        return [raw]
    if not isinstance(raw, list):
        raise RoadError(f"{source}: {type(raw).__name__}, expected a list of roads, each a list of [x, y]")
    return raw


def read_raw_roads(path: Path) -> list[Any]:
    """Read the raw roads of a file, unchecked; see `parse_roads`.

    Raises:
        RoadError: not a regular file, longer than `LARGEST_FILE`, or not roads as JSON.
        OSError: the file cannot be read.
    """
    try:
        return parse_roads(read_regular(path, LARGEST_FILE).decode("utf-8-sig"), str(path))
    except FileError as error:
        raise RoadError(f"{path}: {error}") from None
    except UnicodeDecodeError:
        raise RoadError(f"{path}: not a text file: expected JSON") from None


def read_roads(path_or_text: Path | str) -> list[Road]:
    """Read all roads of a file or of a JSON text.

    Args:
        path_or_text: path of a file; a string that begins with a bracket or a brace is taken as the JSON text itself.

    Raises:
        RoadError: a road is invalid; the message names it, what is wrong with it and what was expected.
        OSError: the file cannot be read.

    Examples:
        >>> from ds_road import read_roads
        >>> [road] = read_roads("[[[125, 0], [125, 25], [125, 50], [125, 75]]]")
        >>> road.lane, round(road.length, 3)
        ('right', 25.0)
    """
    if isinstance(path_or_text, str) and path_or_text.lstrip().startswith(("[", "{")):
        source, raw_roads = "text", parse_roads(path_or_text, "text")
    else:
        source, raw_roads = str(path_or_text), read_raw_roads(Path(path_or_text))
    roads = []
    for index, raw in enumerate(raw_roads):
        try:
            roads.append(road_from_json(raw))
        except RoadError as error:
            raise RoadError(f"{source}: road {index}: {error}") from None
    return roads


def write_roads(roads: list[Road], path: Path) -> None:
    """Write roads to a file for `read_roads`; every number survives the round trip exactly."""
    write_whole(path, json.dumps([road_to_json(road) for road in roads]) + "\n")


def check(raw: Any) -> dict[str, Any]:
    """Check any JSON value as a road; never raises, and takes less than a second.

    Returns:
        The keys valid, reason, length (m), curvature (1/m), turns_count and turns_count_maxitwo; the last four are
        None if the value is not a road at all.

    Examples:
        >>> from ds_road import check
        >>> check([[125, 0], [125, 25], [125, 50]])["reason"]
        'a road has 3 control points, expected 4 to 1000'
    """
    features = dict.fromkeys(("length", "curvature", "turns_count", "turns_count_maxitwo"))
    try:
        road = road_from_json(raw)
    except RoadError as error:
        return {"valid": False, "reason": str(error), **features}
    features = {name: getattr(road, name) for name in features}
    return {"valid": road.validity.valid, "reason": road.validity.reason, **features}


def _is_one_road(raw: Any) -> bool:
    """True for a list of points, even with non-numeric coordinates; a list of lists of points is several roads."""
    if isinstance(raw, dict):
        return "control_points" in raw or "road_points" in raw
    if not isinstance(raw, list) or not raw:
        return False
    return all(isinstance(p, list) and p and not any(isinstance(v, list | dict) for v in p) for p in raw)
