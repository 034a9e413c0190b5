# SPDX-License-Identifier: Apache-2.0
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
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import splev, splprep

from ds_base.bounded_file import FileError, read_regular
from ds_base.bounded_xml import parse_xml
from ds_road.commonroad import constant_width, read_commonroad, without_repeats
from ds_road.files import LARGEST_FILE, road_from_json, road_to_json
from ds_road.geometry import BOX
from ds_road.road import LANE_WIDTH, MAX_POINTS, Road, RoadError, Side

SPACING = 1.25
"""m between two samples at most; chosen: that of 20 samples on the 25 m between control points."""
STEPS_CODE = "digital_siblings_steps_per_piece"
"""Code of the user data in which an exported road says how its pieces are sampled, so that its samples come back."""
_MOST_STEPS = 100
LONGEST = 10_000.0
"""m; chosen: far longer than what fits into the box, and sampled at once."""


def read_opendrive(root: Element, *, most: int) -> list[tuple[str, Road]]:
    """Roads of a file that lie outside of junctions.

    The centre line is the reference line, shifted by the lane offset. Driven is lane -1 in right-hand traffic, lane 1
    in left-hand traffic; its width, which has to be constant, becomes that of both lanes. Height, other lanes, links,
    objects and signals are ignored.

    Args:
        root: root of the document.
        most: largest number of roads.

    Returns:
        Name and road.

    Raises:
        RoadError: a road cannot be read; one line says which and why.
    """
    elements = [element for element in root.iter("road") if element.get("junction", "-1") == "-1"]
    if not elements:
        raise RoadError("an OpenDRIVE file without roads outside of junctions: expected at least one")
    if len(elements) > most:
        raise RoadError(f"{len(elements)} roads, expected at most {most}: divide the file")
    roads = []
    for element in elements:
        name = element.get("name") or element.get("id") or "road"
        try:
            roads.append((name, _road(element)))
        except RoadError as error:
            raise RoadError(f"road {name[:60]!r}: {error}") from None
    return roads


def _road(element: Element) -> Road:
    s, line, headings = _reference_line(element)
    offsets = _polynomial(_entries(element, "lanes/laneOffset"), "s", s, 0.0)
    line = line + offsets[:, None] * np.stack((-np.sin(headings), np.cos(headings)), axis=1)
    left_hand = element.get("rule", "RHT") == "LHT"
    widths = _lane_widths(element, "1" if left_hand else "-1", s)
    return Road.from_road_points(
        without_repeats(line), lane_width=constant_width(widths), lane="left" if left_hand else "right"
    )


def _reference_line(
    element: Element,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Distances s (n,), points (n, 2) and headings (n,) of samples, joints twice."""
    pieces = _entries(element, "planView/geometry")
    if not pieces:
        raise RoadError("it has no planView with geometry")
    if sum(number(piece, "length") for piece in pieces) > LONGEST:
        raise RoadError(f"it is longer than {LONGEST:g} m")
    own = next((one for one in element.findall("userData") if one.get("code") == STEPS_CODE), None)
    steps = 0 if own is None else int(min(max(number(own, "value"), 1), _MOST_STEPS))
    sampled = [_sample(piece, steps) for piece in pieces]
    s, points, headings = (np.concatenate([part[k] for part in sampled]) for k in range(3))
    if len(s) > 4 * MAX_POINTS:  # far beyond, even where joints come twice
        raise RoadError(f"a road has {len(s)} road points, expected 2 to {MAX_POINTS}")
    return s, points, headings


def _sample(piece: Element, steps: int) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    length, s0, heading = (number(piece, key) for key in ("length", "s", "hdg"))
    start = np.array([number(piece, "x"), number(piece, "y")])
    if length <= 0:
        raise RoadError(f"a piece of its geometry has length {length:g}: expected more than 0")
    count = steps or max(1, math.ceil(length / SPACING - 1e-6))
    along = np.linspace(0.0, length, count + 1)
    shape = next((child for child in piece if child.tag in ("line", "arc", "spiral", "paramPoly3")), None)
    if shape is None:
        kinds = ", ".join(child.tag for child in piece)[:40] or "nothing"
        raise RoadError(f"its geometry has {kinds}: expected line, arc, spiral or paramPoly3")
    if shape.tag == "paramPoly3":
        points, directions = _cubic(shape, length, count)
        turned = np.array([[math.cos(heading), math.sin(heading)], [-math.sin(heading), math.cos(heading)]])
        return s0 + along, start + points @ turned, heading + directions
    first, last = 0.0, 0.0
    if shape.tag == "arc":
        first = last = number(shape, "curvature")
    elif shape.tag == "spiral":
        first, last = number(shape, "curvStart"), number(shape, "curvEnd")
    return s0 + along, start + _clothoid(heading, first, last, along), heading + _turned(first, last, along)


def _turned(first: float, last: float, along: NDArray[np.float64]) -> NDArray[np.float64]:
    """Change of heading where the curvature changes linearly, as on lines, arcs and spirals."""
    return first * along + (last - first) * along**2 / (2.0 * along[-1])


def _clothoid(heading: float, first: float, last: float, along: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points relative to the first one, by Gauss-Legendre quadrature of the direction between samples."""
    nodes, weights = np.polynomial.legendre.leggauss(5)
    steps = np.diff(along)
    inner = along[:-1, None] + steps[:, None] * (nodes + 1.0) / 2.0
    angles = heading + first * inner + (last - first) * inner**2 / (2.0 * along[-1])
    moved = np.stack((np.cos(angles) @ weights, np.sin(angles) @ weights), axis=1) * steps[:, None] / 2.0
    return np.vstack((np.zeros(2), np.cumsum(moved, axis=0)))


def _cubic(shape: Element, length: float, count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points and directions in the piece's own axes; of a spline's segment, those of this project's samples."""
    end = length if shape.get("pRange") == "arcLength" else 1.0
    p = np.linspace(0.0, end, count + 1)
    axes = [[number(shape, letter + axis) for letter in "abcd"] for axis in "UV"]
    points: NDArray[np.float64] = np.stack([np.polynomial.polynomial.polyval(p, axis) for axis in axes], axis=1)
    slopes = [np.polynomial.polynomial.polyval(p, np.polynomial.polynomial.polyder(axis)) for axis in axes]
    return points, np.asarray(np.arctan2(slopes[1], slopes[0]), np.float64)


def _lane_widths(element: Element, lane: str, s: NDArray[np.float64]) -> NDArray[np.float64]:
    sections = _entries(element, "lanes/laneSection")
    starts = [number(section, "s") for section in sections]
    widths = np.full(len(s), np.nan)
    for index, section in enumerate(sections):
        found = next((one for one in section.iter("lane") if one.get("id") == lane), None)
        if found is None or found.get("type") != "driving":
            raise RoadError(f"it has no driving lane {lane}")
        end = starts[index + 1] if index + 1 < len(sections) else math.inf
        inside = (s >= starts[index]) & (s <= end)
        widths[inside] = _polynomial(_entries(found, "width"), "sOffset", s[inside] - starts[index], math.nan)
    return widths


def _polynomial(entries: list[Element], start: str, s: NDArray[np.float64], otherwise: float) -> NDArray[np.float64]:
    """Value of a piecewise cubic whose entries begin at increasing distances."""
    rows = sorted(([number(entry, key) for key in (start, *"abcd")] for entry in entries), key=lambda row: row[0])
    table = np.array(rows, np.float64).reshape(-1, 5)
    row = np.searchsorted(table[:, 0] - 1e-9, s, side="right") - 1
    inside, used = row >= 0, table[row[row >= 0]]
    values = np.full(len(s), otherwise)
    values[inside] = np.polynomial.polynomial.polyval(s[inside] - used[:, 0], used[:, 1:].T, tensor=False)
    return values


def _entries(parent: Element, path: str) -> list[Element]:
    """Elements below a parent, no more than a road may have points."""
    found = parent.findall(path)
    if len(found) > MAX_POINTS:
        raise RoadError(f"it has {len(found)} entries of {path}, expected at most {MAX_POINTS}")
    return found


def number(element: Element, name: str) -> float:
    """A finite number in an attribute.

    Raises:
        RoadError: it is missing or no number.
    """
    text = element.get(name, "")
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise RoadError(f"{name} of {element.tag[:30]} is {text[:30]!r}, expected a number")
    return value


SPARSE = 2.5
"""m; road points of SBFT tests that are farther apart are interpolated; chosen: twice the usual spacing."""

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
        root = parse_xml(content)
    except FileError as error:
        raise RoadError(str(error)) from None
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
