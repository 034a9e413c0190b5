# SPDX-License-Identifier: Apache-2.0
"""Reads roads of other tools: ASAM OpenDRIVE, CommonRoad, tests of the SBFT and SDC competitions, and tracks.

All become roads of road points, in metres. A road that fits into the box of 250 m but lies outside of it is moved into
its middle, without turning it.

Tracks are CSV files: those of RoboRacer and of `ds recording locate`, race lines, plain lines of x and y. Columns are
separated by commas, semicolons, tabs or spaces. Names stand in a first line, with or without `#`; without names, the
first two columns are x and y, in metres, or of three with a constant second one the first and the third.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import splev, splprep

from ds_base.bounded_file import FileError, load_json, read_regular
from ds_base.bounded_xml import parse_xml
from ds_base.left_out import LeftOut
from ds_base.progress import logger_of
from ds_road.centre_lines import CentreLine, in_box
from ds_road.commonroad import WIDTH_SPREAD, constant_width, read_commonroad
from ds_road.files import LARGEST_FILE, road_from_json, road_object
from ds_road.opendrive import MOST_ROADS, SPACING, read_opendrive
from ds_road.road import LANE_WIDTH, MAX_POINTS, Road, RoadError, Side, abbreviated

SPARSE = 2.5
"""m; road points of SBFT tests that are farther apart are interpolated; chosen: twice the usual spacing."""
TRACK_NAMES = {
    "x": ("x", "x_m", "pos_x", "x[m]"),
    "y": ("y", "y_m", "pos_y", "y[m]"),
    "right": ("w_tr_right_m", "width_right", "w_right", "right_width"),
    "left": ("w_tr_left_m", "width_left", "w_left", "left_width"),
}
MOST_ROWS = 200_000

LOG = logger_of(__name__)
_Used = TypeVar("_Used")


@dataclass(frozen=True)
class ImportedRoad:
    """A road of another tool."""

    name: str  # as in the file, or of the file
    road: Road  # moved into the box where it lies outside and fits
    moved: tuple[float, float] = (0.0, 0.0)  # by how much, m

    def to_json(self) -> dict[str, Any]:
        """JSON for `ds_road.read_roads`, with the name as `test_id`."""
        return road_object(self.road) | {"test_id": self.name}


def import_roads(
    path: Path,
    left_out: LeftOut | None = None,
    *,
    lane_width: float | None = None,
    lane: Side | None = None,
    scale: float = 1.0,
    sections: tuple[float, float] | None = None,
) -> list[ImportedRoad]:
    """Read the roads of a file, whose content tells the format; RoadError if it has none that can be used.

    Args:
        path: file.
        left_out: takes the roads that cannot be read; if None, the first one is an error.
        lane_width: of tracks, m; if None, half of the track's width, all of it in a single lane, or 4 m.
        lane: to drive in; that of the file, or the right one, if None.
        scale: metres of the road per metre of a track, such as 10 for a car of 1:10.
        sections: length of the sections into which to cut them, as a track that is too large for the box, and distance
            between the starts of two, m; None for whole roads.
    """
    left_out = left_out or LeftOut("roads", strict=True)
    try:
        lines = [line.in_lane(lane) for line in _read(path, left_out, lane_width, lane, scale)]
    except RoadError as error:
        raise RoadError(f"{path}: {error}") from None
    if sections is not None:
        lines = list(chain.from_iterable(_usable(path, left_out, lines, lambda line: line.sections(*sections))))
    roads = list(_usable(path, left_out, lines, lambda line: ImportedRoad(line.name, *in_box(line.road()))))
    if not roads:
        raise RoadError(f"{path}: no road can be used: {left_out.line()}")
    return roads


def _usable(
    path: Path, left_out: LeftOut, lines: Iterable[CentreLine], use: Callable[[CentreLine], _Used]
) -> Iterator[_Used]:
    """What becomes of lines, without those that cannot be used."""
    for line in lines:
        try:
            yield use(line)
        except RoadError as error:
            left_out.add(line.name, RoadError(f"{path}: {error}") if left_out.strict else error)


def _read(path: Path, left_out: LeftOut, lane_width: float | None, lane: Side | None, scale: float) -> list[CentreLine]:
    try:
        content = read_regular(path, LARGEST_FILE)
    except (FileError, OSError) as error:
        raise RoadError(getattr(error, "strerror", None) or str(error)) from None
    beginning = content.lstrip(b"\xef\xbb\xbf \t\r\n")
    if beginning[:1] in (b"{", b"["):
        return _read_sbft(content, path.stem, left_out)
    if beginning[:1] != b"<":
        lanes = 1 if lane == "single" else 2
        left_out.total += 1
        return [_track(content, path.stem, lane_width, lanes, scale)]
    try:
        root = parse_xml(content)
    except FileError as error:
        raise RoadError(str(error)) from None
    kind = root.tag.rpartition("}")[2]
    if kind == "OpenDRIVE":
        return read_opendrive(root, left_out)
    if kind == "commonRoad":
        left_out.total += 1
        return [CentreLine.of(path.stem, read_commonroad(root))]
    raise RoadError(f"XML of {root.tag[:40]!r}: expected OpenDRIVE or commonRoad")


def _track(content: bytes, name: str, lane_width: float | None, lanes: int, scale: float) -> CentreLine:
    """The line in the middle of a track; where it has no widths, that of the file."""
    points, sides = read_track(content)
    points = scale * points
    if sides is None:
        return CentreLine(name, points, lane_width or LANE_WIDTH)
    right, left = scale * sides.T
    along = np.gradient(points, axis=0)
    normal = np.stack((-along[:, 1], along[:, 0]), axis=1) / np.maximum(np.hypot(*along.T), 1e-12)[:, None]
    middle = points + ((left - right) / 2.0)[:, None] * normal
    widths = (left + right) / lanes
    if lane_width is None and np.ptp(widths) > WIDTH_SPREAD:  # unlike a lane's, a track's width may vary
        lane_width = float(widths.min())
        LOG.info(
            "%s: lanes of %.2f to %.2f m: they are as wide as in the narrowest place", name, widths.min(), widths.max()
        )
    return CentreLine(name, middle, lane_width or constant_width(widths))


def _read_sbft(content: bytes, stem: str, left_out: LeftOut) -> list[CentreLine]:
    try:
        raw = load_json(content)
    except FileError as error:
        raise RoadError(str(error)) from None
    tests = raw if isinstance(raw, list) else [raw]
    if not tests or not all(isinstance(test, dict) for test in tests):
        raise RoadError("JSON without tests: expected objects with road_points")
    if len(tests) > MOST_ROADS:
        raise RoadError(f"{len(tests)} tests, expected at most {MOST_ROADS}: divide the file")
    lines = []
    for index, test in enumerate(tests):
        keys = [test.get(key) for key in ("name", "test_id", "id", "_id")]
        keys = [key.get("$oid") if isinstance(key, dict) else key for key in keys]
        written_key = next((key for key in keys if isinstance(key, str | int)), None)
        name = str(written_key) if written_key is not None else stem if len(tests) == 1 else f"{stem}_{index}"
        left_out.total += 1
        try:
            lines.append(CentreLine.of(name[:200], _sbft_road(test)))
        except RoadError as error:
            left_out.add(name[:60], RoadError(f"test {index}: {error}") if left_out.strict else error)
    return lines


def _sbft_road(test: dict[str, Any]) -> Road:
    points = test.get("road_points")
    if isinstance(points, list) and points and all(isinstance(point, dict) for point in points):  # SDC 2025 and 2026
        ordered = sorted(points, key=lambda point: point.get("sequence_number", 0))
        test = {**test, "road_points": [[point.get("x"), point.get("y")] for point in ordered]}
    if "interpolated_points" not in test:
        road = road_from_json(test)
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


def read_track(content: bytes) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """Read a track: (n, 2) centre line in driving order, and (n, 2) distances to its right and left border or None, m.

    A `RoadError` names the line of the file.
    """
    try:
        lines = content.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise RoadError("no text: expected a track of lines x,y") from None
    names: list[str] = []
    rows: list[list[float]] = []
    for number, line in enumerate(lines, start=1):
        cells = _cells(line.strip().lstrip("#"))
        if not cells:
            continue
        if line.lstrip().startswith("#") or (not rows and not any(map(_is_number, cells))):
            names = names if rows else [cell.lower() for cell in cells]
            continue
        if not all(map(_is_number, cells)) or (rows and len(cells) != len(rows[0])):
            raise RoadError(f"line {number} is {abbreviated(line.strip())}, expected numbers as in the lines before")
        rows.append([float(cell) for cell in cells])
        if len(rows) > MOST_ROWS:
            raise RoadError(f"more than {MOST_ROWS} lines: divide the track")
    if len(rows) < 2:
        raise RoadError("not a track: expected at least two lines x,y, separated by commas, semicolons or spaces")
    table = np.array(rows)
    columns = {
        key: next((names.index(name) for name in aliases if name in names), None)
        for key, aliases in TRACK_NAMES.items()
    }
    if len(names) != table.shape[1]:
        if len(names) > table.shape[1] and columns["x"] is not None and columns["y"] is not None:
            raise RoadError(f"{len(names)} columns have names, but lines have {table.shape[1]} numbers: add the others")
        columns = dict.fromkeys(TRACK_NAMES)  # a remark, not names
    x, y = columns["x"], columns["y"]
    if x is None or y is None:
        if any(columns.values()) or len(names) == table.shape[1] or table.shape[1] < 2:
            raise RoadError(f"columns {', '.join(names)[:60] or 'without names'}: expected x and y among them")
        x, y = 0, 1
        if table.shape[1] == 3 and not np.ptp(table[:, 1]) and np.ptp(table[:, 2]):
            y = 2  # Unity's heights, as in waypoints of the Donkey simulator
    if not np.isfinite(table[:, [x, y]]).all():
        row = int(np.flatnonzero(~np.isfinite(table[:, [x, y]]).all(axis=1))[0])
        raise RoadError(f"row {row + 1} of the track has no finite x and y: correct or delete it")
    right, left = columns["right"], columns["left"]
    if right is None or left is None:
        return table[:, [x, y]], None
    return table[:, [x, y]], table[:, [right, left]]


def _cells(line: str) -> list[str]:
    for separator in (";", ",", "\t"):
        if separator in line:
            cells = [cell.strip() for cell in line.rstrip(separator).split(separator)]
            return cells if separator == "," else [cell.replace(",", ".") for cell in cells]  # decimal commas
    return re.split(r"\s+", line.strip()) if line.strip() else []


def _is_number(text: str) -> bool:
    try:
        return not math.isinf(float(text))
    except ValueError:
        return False
