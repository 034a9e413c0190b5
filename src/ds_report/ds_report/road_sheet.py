# SPDX-License-Identifier: Apache-2.0
"""A road at the size of a model car: points to tape out, and a drawing with a grid of metres."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_analysis.common.chart import write
from ds_analysis.common.statistics import Array
from ds_road import Road
from ds_road.geometry import arc_lengths

SPACING = 0.1
"""Distance between the points to tape out, m at the car's size; chosen: on bends with a radius of 0.25 m, the
narrowest, the chord between two points leaves the arc by 5 mm, less than the width of tape."""
_PER_METRE = 10
_MARGIN = 0.25
"""m at the car's size around the road, so that the grid's origin lies beside it."""
_PIXELS = 900
_LEFT, _TOP, _BOTTOM, _RIGHT = 60, 56, 46, 24
_FAINT, _FAINTER = (190, 190, 190), (228, 228, 228)
_EDGE, _CENTRE, _LANE = (20, 20, 20), (205, 150, 0), (0, 114, 178)


@dataclass(frozen=True, kw_only=True, eq=False)
class RoadSheet:
    """A road at the car's size; the origin is the lower left corner of a rectangle around it, x right and y up, m.

    Attributes:
        width: extent of the rectangle along x, m.
        height: extent of the rectangle along y, m.
        stations: (n,) distances along the centre line, m.
        centre: (n, 2) points of the yellow centre line.
        left: (n, 2) points of the left white edge line.
        right: (n, 2) points of the right white edge line.
        lane: (n, 2) points of the centre of the driven lane, where no line is.
        lane_width: width of a lane, m.
    """

    width: float
    height: float
    stations: Array
    centre: Array
    left: Array
    right: Array
    lane: Array
    lane_width: float

    def csv(self) -> str:
        """The points, one row per station, in metres to the millimetre."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        names = ("centre_line", "left_edge", "right_edge", "lane_centre")
        writer.writerow(["station_m", *(f"{name}_{axis}_m" for name in names for axis in "xy")])
        for k, station in enumerate(self.stations):
            points = (line[k] for line in (self.centre, self.left, self.right, self.lane))
            writer.writerow([f"{station:.3f}", *(f"{value:.3f}" for point in points for value in point)])
        return out.getvalue()


def sheet_of(road: Road, scale: float) -> RoadSheet:
    """Scale a road to the size of a car.

    Args:
        road: road to tape out.
        scale: metres of the road per metre of the car's, such as 16 for a car of 1:16.
    """
    lines = [road.points, road.left_edge, road.right_edge, road.lane_centre]
    # All lines have a point for each sample of the centre line, abreast of it.
    along = arc_lengths(road.points) / scale
    stations = np.append(np.arange(0.0, along[-1] - 0.5 * SPACING, SPACING), along[-1])
    corner = np.vstack(lines[1:3]).min(axis=0) / scale - _MARGIN
    scaled = [
        np.column_stack([np.interp(stations, along, line[:, axis] / scale) for axis in (0, 1)]) - corner
        for line in lines
    ]
    extent = np.vstack(lines[1:3]).max(axis=0) / scale - corner + _MARGIN
    return RoadSheet(
        width=float(extent[0]), height=float(extent[1]), stations=stations, centre=scaled[0], left=scaled[1],
        right=scaled[2], lane=scaled[3], lane_width=road.lane_width / scale,
    )  # fmt: skip


def draw_sheet(sheet: RoadSheet, title: str) -> NDArray[np.uint8]:
    """Draw a road on white, for print: edges black, centre line amber, driven lane dotted, a grid of whole metres.

    Args:
        sheet: road at the car's size.
        title: heading.

    Returns:
        (rows, columns, 3) uint8 RGB.
    """
    scale = _PIXELS / max(sheet.width, sheet.height)
    columns, rows = int(np.ceil(sheet.width * scale)), int(np.ceil(sheet.height * scale))
    image = np.full((rows + _TOP + _BOTTOM, max(columns + _LEFT + _RIGHT, 560), 3), 255, np.uint8)

    def at(points: Array) -> NDArray[np.int32]:
        x, y = np.asarray(points, np.float64).reshape(-1, 2).T
        return np.round(16 * np.column_stack((_LEFT + x * scale, _TOP + rows - y * scale))).astype(np.int32)

    def line(points: Array, colour: tuple[int, int, int], width: int) -> None:
        cv2.polylines(image, [at(points)], False, colour, width, cv2.LINE_AA, 4)

    for axis, (extent, other) in enumerate(((sheet.width, sheet.height), (sheet.height, sheet.width))):
        for half in range(int(2 * extent) + 1):
            ends = np.array([[half / 2, 0.0], [half / 2, other]])
            line(ends[:, ::-1] if axis else ends, _FAINTER if half % 2 else _FAINT, 1)
            if half % 2 == 0:
                x, y = (at(ends[:1, ::-1] if axis else ends[:1]) // 16)[0]
                write(image, f"{half // 2}", (int(x) - 22, int(y) + 4) if axis else (int(x) - 4, int(y) + 18), 0.42)
    for edge in (sheet.left, sheet.right):
        line(edge, _EDGE, 3)
    line(sheet.centre, _CENTRE, 3)
    for point in at(sheet.lane[::2]):
        cv2.circle(image, (int(point[0]), int(point[1])), 2 << 4, _LANE, -1, cv2.LINE_AA, 4)
    for k in range(len(sheet.stations)):
        if k % _PER_METRE == 0 and k < len(sheet.stations) - 1:
            line(np.array([sheet.left[k], sheet.right[k]]), _FAINT, 1)
    ahead = sheet.lane[1] - sheet.lane[0]
    ahead = ahead / np.hypot(*ahead)
    side = np.array((-ahead[1], ahead[0]))
    half_lane = 0.35 * sheet.lane_width
    arrow = sheet.lane[0] + np.array([1.6 * ahead * half_lane, side * half_lane, -side * half_lane])
    cv2.fillPoly(image, [at(arrow)], _LANE, cv2.LINE_AA, 4)
    write(image, title, (12, 22), 0.52)
    write(image, "grid 0.5 m; black: white edge lines; amber: yellow centre line; arrow: start", (12, 42), 0.42)
    size = (
        f"{sheet.width:.1f} x {sheet.height:.1f} m, length {sheet.stations[-1]:.1f} m, lanes {sheet.lane_width:.3f} m"
    )
    write(image, size, (12, image.shape[0] - 10), 0.45)
    return image
