"""Roads as JSON: a list of roads, each a list of [x, y] control points in metres."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ds_road.road import Road, RoadError


def parse_roads(text: str, source: str) -> list[Any]:
    """The raw roads of a JSON text, unchecked; a single road counts as a list of one.

    Raises:
        RoadError: not JSON, or not a list.
    """
    try:
        raw = json.loads(text)
    except (json.JSONDecodeError, RecursionError) as error:
        raise RoadError(f"{source}: not JSON ({error}): expected a list of roads") from None
    if not isinstance(raw, list):
        raise RoadError(f"{source}: {type(raw).__name__}, expected a list of roads, each a list of [x, y]")
    return [raw] if _is_one_road(raw) else raw


def read_raw_roads(path: Path) -> list[Any]:
    """The raw roads of a file, unchecked; see `parse_roads`."""
    try:
        return parse_roads(path.read_text(), str(path))
    except UnicodeDecodeError:
        raise RoadError(f"{path}: not a text file: expected JSON") from None


def read_roads(path: Path) -> list[Road]:
    """Every road of a file.

    Raises:
        RoadError: names the road, what is wrong with it and what was expected.
        OSError: the file cannot be read.
    """
    roads = []
    for index, raw in enumerate(read_raw_roads(path)):
        try:
            roads.append(Road(raw))
        except RoadError as error:
            raise RoadError(f"{path}: road {index}: {error}") from None
    return roads


def write_roads(roads: list[Road], path: Path) -> None:
    """Write roads as `read_roads` takes them."""
    path.write_text(json.dumps([road.control_points for road in roads]) + "\n")


def check(raw: Any) -> dict[str, Any]:
    """What can be said of any JSON value as a road; never raises.

    Returns:
        valid, reason, length (m), curvature (1/m), turns_count, turns_count_published; the measures are None when
        the value makes no road at all.
    """
    measures = dict.fromkeys(("length", "curvature", "turns_count", "turns_count_published"))
    try:
        road = Road(raw)
    except RoadError as error:
        return {"valid": False, "reason": str(error), **measures}
    measures = {name: getattr(road, name) for name in measures}
    return {"valid": road.validity.valid, "reason": road.validity.reason, **measures}


def _is_one_road(raw: list[Any]) -> bool:
    """A list of pairs of numbers is one road; a list of lists of pairs is several."""
    return bool(raw) and all(isinstance(p, list) and p and all(isinstance(v, int | float) for v in p) for p in raw)
