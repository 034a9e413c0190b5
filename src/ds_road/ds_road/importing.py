"""Reads roads of other tools: ASAM OpenDRIVE, CommonRoad scenarios, and tests of the SBFT tool competition.

All become roads of road points, in metres. A road that fits into the box of 250 m but lies outside of it is moved into
its middle, without turning it.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import splev, splprep

from ds_road.bounded_file import FileError, read_regular
from ds_road.commonroad import read_commonroad
from ds_road.files import LARGEST_FILE, road_from_json, road_to_json
from ds_road.opendrive_reading import SPACING, read_opendrive
from ds_road.road import LANE_WIDTH, MAX_POINTS, Road, RoadError, Side
from ds_road.validity import BOX

SPARSE = 2.5
"""m; road points of SBFT tests that are farther apart are interpolated; chosen: twice the usual spacing."""

MOST_ELEMENTS = 1_000_000
"""Elements of an XML file; chosen: those of 16 MiB of points, read within seconds."""
MOST_ROADS = 2_000
"""Roads of a file of another tool; chosen: as many as a regression suite has tests, read within seconds."""


@dataclass(frozen=True)
class ImportedRoad:
    """A road of another tool.

    Attributes:
        name: as in the file, or of the file.
        road: read, and moved into the box where it lies outside and fits.
        moved: by how much, m; zeros if it lies where the file has it.
    """

    name: str
    road: Road
    moved: tuple[float, float] = (0.0, 0.0)

    def to_json(self) -> dict[str, Any]:
        """JSON for `ds_road.read_roads`, with the name as `test_id`."""
        raw = road_to_json(self.road)
        return {**(raw if isinstance(raw, dict) else {"control_points": raw}), "test_id": self.name}


class _BoundedTree(ElementTree.TreeBuilder):
    """Builds the tree of an XML document, in any encoding, without a document type and of bounded size."""

    _left = MOST_ELEMENTS

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        """Refuse a document type, before anything that it defines."""
        raise RoadError("XML with a document type: remove it, as definitions in it could fill the memory")

    def start(self, tag: str, attrs: dict[str, str]) -> Any:
        """Open an element."""
        self._left -= 1
        if self._left < 0:
            raise RoadError(f"more than {MOST_ELEMENTS} elements, the limit for a file of roads: divide it")
        return super().start(tag, attrs)


def import_roads(path: Path) -> list[ImportedRoad]:
    """Read all roads of a file; its content tells the format.

    Raises:
        RoadError: not one of the formats, or a road that cannot be used; one line names the file.
        OSError: the file cannot be read.

    Examples:
        >>> from pathlib import Path
        >>> from ds_road import Road
        >>> from ds_road.export import write_all
        >>> from ds_road.importing import import_roads
        >>> road = Road([(125, 0), (125, 25), (125, 50), (140, 75)])
        >>> [file] = write_all([road], ["bend"], Path("exported"), "opendrive")
        >>> [found] = import_roads(file)
        >>> abs(found.road.length - road.length) < 0.01
        True
    """
    try:
        return [_in_box(name, road) for name, road in _read(path)]
    except RoadError as error:
        raise RoadError(f"{path}: {error}") from None


def _read(path: Path) -> list[tuple[str, Road]]:
    try:
        content = read_regular(path, LARGEST_FILE)
    except FileError as error:
        raise RoadError(str(error)) from None
    beginning = content.lstrip(b"\xef\xbb\xbf \t\r\n")
    if beginning[:1] in (b"{", b"["):
        return _read_sbft(content, path.stem)
    if beginning[:1] != b"<":
        raise RoadError("neither XML nor JSON: expected OpenDRIVE, CommonRoad or SBFT's JSON")
    try:
        root = ElementTree.fromstring(content, ElementTree.XMLParser(target=_BoundedTree()))
    except RoadError:
        raise
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise RoadError(f"not XML ({error})") from None
    if root.tag == "OpenDRIVE":
        return read_opendrive(root, most=MOST_ROADS)
    if root.tag == "commonRoad":
        return [(path.stem, read_commonroad(root))]
    raise RoadError(f"XML of {root.tag[:40]!r}: expected OpenDRIVE or commonRoad")


def _read_sbft(content: bytes, stem: str) -> list[tuple[str, Road]]:
    try:
        raw = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise RoadError(f"not JSON ({str(error)[:100]})") from None
    tests = raw if isinstance(raw, list) else [raw]
    if not tests or not all(isinstance(test, dict) for test in tests):
        raise RoadError("JSON without tests: expected objects with road_points")
    if len(tests) > MOST_ROADS:
        raise RoadError(f"{len(tests)} tests, expected at most {MOST_ROADS}: divide the file")
    found = []
    for index, test in enumerate(tests):
        given = next((test[key] for key in ("name", "test_id", "id") if isinstance(test.get(key), str | int)), None)
        name = str(given) if given is not None else stem if len(tests) == 1 else f"{stem}_{index}"
        try:
            found.append((name[:200], _sbft_road(test)))
        except RoadError as error:
            raise RoadError(f"test {index}: {error}") from None
    return found


def _sbft_road(test: dict[str, Any]) -> Road:
    if "interpolated_points" not in test:
        road = road_from_json({key: value for key, value in test.items() if key != "interpolated_points"})
        if not road.sampled:
            return road
        gaps = np.hypot(*np.diff(road.points, axis=0).T)
        if gaps.max() <= SPARSE or len(gaps) < 3:
            return road
        return Road.from_road_points(_interpolated(road.points), lane_width=road.lane_width, lane=road.lane)
    points = test["interpolated_points"]
    if isinstance(points, list):  # x, y, z and width
        points = [point[:2] if isinstance(point, list) else point for point in points]
    lane: Side = test.get("lane", "right")
    return Road.from_road_points(points, lane_width=test.get("lane_width", LANE_WIDTH), lane=lane)


def _interpolated(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Cubic spline through the points, as the competition's pipeline lays it, sampled more densely."""
    count = math.ceil(np.hypot(*np.diff(points, axis=0).T).sum() * 1.2 / SPACING)
    if count >= MAX_POINTS:
        raise RoadError(f"it takes {count + 1} road points to interpolate, expected 2 to {MAX_POINTS}: give them all")
    spline, _ = splprep(points.T, s=0.0, k=3)
    return np.stack(splev(np.linspace(0.0, 1.0, count + 1), spline), axis=1)


def _in_box(name: str, road: Road) -> ImportedRoad:
    edges = np.vstack((road.left_edge, road.right_edge))
    low, high = edges.min(axis=0), edges.max(axis=0)
    inside = low.min() >= 0 and high.max() <= BOX
    if inside or not road.sampled or (high - low).max() > BOX:
        return ImportedRoad(name, road)
    shift = np.round(BOX / 2 - (low + high) / 2, 3)
    moved = Road.from_road_points(road.points + shift, lane_width=road.lane_width, lane=road.lane)
    return ImportedRoad(name, moved, (float(shift[0]), float(shift[1])))
