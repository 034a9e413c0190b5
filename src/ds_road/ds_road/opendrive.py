# SPDX-License-Identifier: Apache-2.0
"""Writes roads as ASAM OpenDRIVE 1.7, and reads those of 1.4 to 1.8, as a driven lane's inner border and width.

Written is one road with its centre line as the reference line, a left and a right lane. Vehicles drive in the right
lane, id -1, of right-hand traffic, or in the left lane, id 1, of left-hand traffic. The reference line passes through
every sample of `Road.points`:

* A road of control points is written as what it is: each segment of its Catmull-Rom spline is a cubic polynomial, which
  a `paramPoly3` represents exactly. It stays within 1 um of the spline.
* A road of road points has one `line` from each point to the next.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import cast
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from ds_base.folder_files import enter_folder, write_whole
from ds_base.left_out import LeftOut
from ds_road.centre_lines import CentreLine
from ds_road.commonroad import constant_width
from ds_road.geometry import SAMPLES_PER_SEGMENT, apart
from ds_road.road import MAX_POINTS, Road, RoadError, Side

_STRAIGHT = 1e-9
"""m of bend in a segment that still counts as a straight line."""
_MARK_WIDTH = 0.12
"""m; width of the painted lines (chosen: common on rural roads)."""
SPACING = 1.25
"""m between two samples at most; chosen: that of 20 samples on the 25 m between control points."""
STEPS_CODE = "digital_siblings_steps_per_piece"
"""Code of the user data in which an exported road says how its pieces are sampled, so that its samples come back."""
LANE_CODE = "digital_siblings_lane"
"""Code of the user data in which an exported road names a lane that no rule of traffic does."""
_MOST_STEPS = 100
MOST_ROADS = 2_000
"""Roads of a file of another tool; chosen: as many as a regression suite has tests, read within seconds."""
LONGEST = 10_000.0
"""m; chosen: far longer than what fits into the box, and sampled at once."""
JOINT = 0.01
"""Largest gap between two pieces, m: what ASAM's checker allows."""


def write_all(roads: Sequence[Road], names: Sequence[str], folder: Path) -> list[Path]:
    """Write one OpenDRIVE file per road, named after it, in place of files of the same name.

    Of names, other characters than letters, digits, `_`, `-` and `.` become `_`; RoadError for two equal ones, and for
    no road at all.
    """
    if not roads:
        raise RoadError("no road to export: expected at least one")
    # No other character in a file's name, no hidden file.
    plain = (re.sub(r"[^A-Za-z0-9_.-]", "_", name).lstrip(".")[:200] for name in names)
    files = [f"{name or 'road'}.xodr" for name in plain]
    if twice := sorted({file for file in files if files.count(file) > 1}):
        raise RoadError(f"two roads are called {twice[0]}: give them different names")
    enter_folder(folder)
    paths = [folder / file for file in files]
    for road, name, path in zip(roads, names, paths, strict=True):
        write_whole(path, opendrive(road, name))
    return paths


def opendrive(road: Road, name: str) -> str:
    """A road as an OpenDRIVE 1.7 file, XML."""
    geometry, length = _plan_view(road)
    edges = np.vstack((road.left_edge, road.right_edge))
    (west, south), (east, north) = edges.min(axis=0), edges.max(axis=0)
    root = ElementTree.Element("OpenDRIVE")
    _add(
        root, "header", revMajor="1", revMinor="7", name=_printable(name), version="1.0",
        north=north, south=south, east=east, west=west,
    )  # fmt: skip
    rule = "LHT" if road.lane == "left" else "RHT"
    body = _add(root, "road", name=_printable(name), length=length, id="1", junction="-1", rule=rule)
    _add(body, "type", s="0", type="rural")
    body.append(geometry)
    lanes = _add(body, "lanes")
    section = _add(lanes, "laneSection", s="0")
    _lane(_add(section, "left"), 1, road.half_width, "solid")
    _lane(_add(section, "center"), 0, None, "solid" if road.has_centre_line else "none", "yellow")
    _lane(_add(section, "right"), -1, road.half_width, "solid")
    _add(body, "userData", code="digital_siblings_road_id", value=road.road_id)
    if road.lane in ("middle", "single"):
        _add(body, "userData", code=LANE_CODE, value=road.lane)
    _add(body, "userData", code=STEPS_CODE, value="1" if road.sampled else str(SAMPLES_PER_SEGMENT - 1))
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def _plan_view(road: Road) -> tuple[ElementTree.Element, float]:
    """The reference line, and its length in m."""
    element = ElementTree.Element("planView")
    s = 0.0
    for start, coefficients in _pieces(road):
        # Column 0 of the coefficients belongs to x, column 1 to y; row k to p to the power of k + 1, p in [0, 1].
        heading = math.atan2(coefficients[0, 1], coefficients[0, 0])
        cos, sin = math.cos(heading), math.sin(heading)
        u = coefficients @ np.array([cos, sin])
        v = coefficients @ np.array([-sin, cos])
        straight = np.abs(v).max() < _STRAIGHT
        length = float(math.hypot(*coefficients.sum(axis=0))) if straight else _arc_length(coefficients)
        piece = _add(element, "geometry", s=s, x=start[0], y=start[1], hdg=heading, length=length)
        if straight:
            _add(piece, "line")
        else:
            _add(
                piece, "paramPoly3", aU="0", bU=u[0], cU=u[1], dU=u[2], aV="0", bV="0", cV=v[1], dV=v[2],
                pRange="normalized",
            )  # fmt: skip
        s += length
    return element, s


def _pieces(road: Road) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Start of each piece of the reference line, and the (3, 2) coefficients of its cubic without the constant."""
    points = road.points
    if road.sampled:
        zero = np.zeros(2)
        return [(a, np.stack((b - a, zero, zero))) for a, b in zip(points[:-1], points[1:], strict=True)]
    pieces = []
    last = SAMPLES_PER_SEGMENT - 1
    # The samples of a segment are uniform in the parameter of its cubic, so four of them determine it.
    chosen = np.round(np.linspace(0, last, 4)).astype(int)
    p = chosen[1:] / last
    vandermonde = np.stack((p, p**2, p**3), axis=1)
    for begin in range(0, len(points) - 1, last):
        segment = points[begin : begin + last + 1]
        pieces.append((segment[0], np.linalg.solve(vandermonde, segment[chosen[1:]] - segment[0])))
    return pieces


def _arc_length(coefficients: NDArray[np.float64]) -> float:
    """Length of a cubic over [0, 1], m, by Gauss-Legendre quadrature on eight parts."""
    nodes, weights = np.polynomial.legendre.leggauss(8)
    parts = 8
    p = ((nodes + 1.0) / 2.0 + np.arange(parts)[:, None]).ravel() / parts
    derivative = np.stack((np.ones_like(p), 2.0 * p, 3.0 * p**2), axis=1) @ coefficients
    return float(np.tile(weights, parts) @ np.hypot(*derivative.T) / (2.0 * parts))


def _lane(side: ElementTree.Element, number: int, width: float | None, mark: str, colour: str = "white") -> None:
    lane = _add(side, "lane", id=str(number), type="none" if width is None else "driving", level="false")
    if width is not None:
        _add(lane, "width", sOffset="0", a=width, b="0", c="0", d="0")
    _add(
        lane, "roadMark", sOffset="0", type=mark, weight="standard", color=colour, width=_MARK_WIDTH, laneChange="none"
    )


def _add(parent: ElementTree.Element, tag: str, **attributes: str | float) -> ElementTree.Element:
    """Append an element; numbers are written so that every bit comes back."""
    texts = {key: value if isinstance(value, str) else repr(float(value)) for key, value in attributes.items()}
    return ElementTree.SubElement(parent, tag, texts)


def _printable(name: str) -> str:
    """A name without the characters that XML 1.0 forbids."""
    return "".join(c for c in name if c.isprintable())


def read_opendrive(root: Element, left_out: LeftOut) -> list[CentreLine]:
    """Roads of a file that lie outside of junctions.

    Driven is the innermost driving lane: to the right of the reference line in right-hand traffic, or, of a road that
    has none there, the one to its left, against the line. The road's centre line is that lane's inner border, and its
    width, which has to be constant, becomes that of both lanes. Height, other lanes, links, objects, signals and
    namespaces are ignored. RoadError if there is no road outside of junctions, or too many.
    """
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
    elements = [element for element in root.iter("road") if element.get("junction", "-1") == "-1"]
    if not elements:
        raise RoadError("an OpenDRIVE file without roads outside of junctions: expected at least one")
    if len(elements) > MOST_ROADS:
        raise RoadError(f"{len(elements)} roads, expected at most {MOST_ROADS}: divide the file")
    roads = []
    for element in elements:
        name = element.get("name") or element.get("id") or "road"
        left_out.total += 1
        try:
            roads.append(_road(element, name))
        except RoadError as error:
            left_out.add(name[:60], RoadError(f"road {name[:60]!r}: {error}") if left_out.strict else error)
    return roads


def _road(element: Element, name: str) -> CentreLine:
    s, line, headings = _reference_line(element)
    left = np.stack((-np.sin(headings), np.cos(headings)), axis=1)
    line = line + _polynomial(_entries(element, "lanes/laneOffset"), "s", s, 0.0)[:, None] * left
    side: Side = "left" if element.get("rule", "RHT") == "LHT" else "right"
    sections = _entries(element, "lanes/laneSection")
    starts = [number(section, "s") for section in sections]
    against = all(_driven(section, side) is None for section in sections)
    inner, outer = np.full(len(s), np.nan), np.full(len(s), np.nan)
    for index, section in enumerate(sections):
        end = starts[index + 1] if index + 1 < len(sections) else math.inf
        inside = (s >= starts[index]) & (s <= end)
        borders = _driven(section, ("right" if side == "left" else "left") if against else side)
        if borders is None:
            raise RoadError(f"it has no driving lane from {starts[index]:g} m on")
        inner[inside], outer[inside] = _borders(borders, s[inside] - starts[index])
    width = constant_width(outer - inner)
    if np.ptp(inner) > JOINT:
        raise RoadError(
            f"the inner border of its driven lane moves by {np.ptp(inner):.2f} m: expected a constant offset"
        )
    sign = -1.0 if (side == "right") is not against else 1.0
    # Joints come twice, or with a gap that is allowed.
    points = apart(line + (sign * inner)[:, None] * left, JOINT)
    own = _user_data(element, LANE_CODE)
    if own is not None and (of_export := own.get("value")) in ("middle", "single"):
        return CentreLine(name, points, width * (1.0 + (of_export == "single")), cast(Side, of_export))
    return CentreLine(name, points[::-1] if against else points, width, side)


def _driven(section: Element, side: Side) -> list[Element] | None:
    """Lanes of a side from the inside to the innermost driving one; None if none is driving."""
    lanes = [lane for lane in section.findall(f"{side}/lane") if lane.get("id", "0").lstrip("-").isdecimal()]
    lanes.sort(key=lambda lane: abs(int(lane.get("id", "0"))))
    driving = next((index for index, lane in enumerate(lanes) if lane.get("type") == "driving"), None)
    return None if driving is None else lanes[: driving + 1]


def _borders(lanes: Sequence[Element], along: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Distances of the inner and the outer border of the last lane from the line, m."""
    inner = outer = np.zeros(len(along))
    for lane in lanes:
        borders = _entries(lane, "border")
        inner = outer
        if borders and not lane.findall("width"):
            outer = np.abs(_polynomial(borders, "sOffset", along, math.nan))
        else:
            outer = inner + _polynomial(_entries(lane, "width"), "sOffset", along, math.nan)
    return inner, outer


def _reference_line(element: Element) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Distances s (n,), points (n, 2) and headings (n,) of samples, joints twice."""
    pieces = _entries(element, "planView/geometry")
    if not pieces:
        raise RoadError("it has no planView with geometry")
    if sum(number(piece, "length") for piece in pieces) > LONGEST:
        raise RoadError(f"it is longer than {LONGEST:g} m")
    own = _user_data(element, STEPS_CODE)
    steps = 0 if own is None else int(min(max(number(own, "value"), 1), _MOST_STEPS))
    sampled = [_sample(piece, steps) for piece in pieces]
    s, points, headings = (np.concatenate([part[k] for part in sampled]) for k in range(3))
    if len(s) > 4 * MAX_POINTS:  # far beyond, even where joints come twice
        raise RoadError(f"a road has {len(s)} road points, expected 2 to {MAX_POINTS}")
    return s, points, headings


def _user_data(element: Element, code: str) -> Element | None:
    return next((one for one in element.findall("userData") if one.get("code") == code), None)


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
    entries = parent.findall(path)
    if len(entries) > MAX_POINTS:
        raise RoadError(f"it has {len(entries)} entries of {path}, expected at most {MAX_POINTS}")
    return entries


def number(element: Element, name: str) -> float:
    """A finite number in an attribute, or a `RoadError`."""
    text = element.get(name, "")
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise RoadError(f"{name} of {element.tag[:30]} is {text[:30]!r}, expected a number")
    return value
