# SPDX-License-Identifier: Apache-2.0
"""Exports roads as ASAM OpenDRIVE, for simulators and scenario editors.

OpenDRIVE 1.7 (ASAM, 2021): one road with its centre line as the reference line, a left and a right lane. Vehicles drive
in the right lane, id -1, of right-hand traffic, or in the left lane, id 1, of left-hand traffic. The reference line
passes through every sample of `Road.points`:

* A road of control points is written as what it is: each segment of its Catmull-Rom spline is a cubic polynomial, which
  a `paramPoly3` represents exactly. It stays within 1 um of the spline.
* A road of road points has one `line` from each point to the next.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from ds_base.atomic_files import write_whole
from ds_base.folder_files import enter_folder
from ds_road.geometry import SAMPLES_PER_SEGMENT
from ds_road.opendrive import LANE_CODE, STEPS_CODE
from ds_road.road import Road, RoadError

_STRAIGHT = 1e-9
"""m of bend in a segment that still counts as a straight line."""
_MARK_WIDTH = 0.12
"""m; width of the painted lines (chosen: common on rural roads)."""


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
