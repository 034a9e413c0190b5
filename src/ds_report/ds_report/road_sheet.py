# SPDX-License-Identifier: Apache-2.0
"""A road at the size of a model car: points to tape out, and a drawing with a grid of metres."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ds_analysis.common.statistics import Array
from ds_base.figures import draw_figure
from ds_base.palette import SERIES
from ds_road import Road
from ds_road.geometry import arc_lengths

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SPACING = 0.1
"""Distance of points to tape out, m at the car's size; chosen: on the narrowest bend tape covers the error, 5 mm."""
_PER_METRE = round(1 / SPACING)
_MARGIN = 0.25
"""m at the car's size around the road, so that the grid's origin lies beside it."""
_PIXELS = 900


@dataclass(frozen=True, kw_only=True, eq=False)
class RoadSheet:
    """A road at the car's size; the origin is the lower left corner of a rectangle around it, x right and y up, m.

    Attributes:
        height: extent of the rectangle along y, m.
        stations: (n,) distances along the centre line, m.
        centre: (n, 2) points of the yellow centre line.
        left: (n, 2) points of the left white edge line.
        right: (n, 2) points of the right white edge line.
        lane: (n, 2) points of the centre of the driven lane, where no line is.
        lane_width: width of a lane, m.
        two_lanes: whether there is a centre line to tape.
    """

    width: float
    height: float
    stations: Array
    centre: Array
    left: Array
    right: Array
    lane: Array
    lane_width: float
    two_lanes: bool

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
    """Scale a road to the size of a car: 16 metres of the road for each of a car of 1:16."""
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
        width=float(extent[0]),
        height=float(extent[1]),
        stations=stations,
        centre=scaled[0],
        left=scaled[1],
        right=scaled[2],
        lane=scaled[3],
        lane_width=road.lane_width / scale,
        two_lanes=road.has_centre_line,
    )


def draw_sheet(sheet: RoadSheet, title: str) -> NDArray[np.uint8]:
    """Draw a road for print, as (rows, columns, 3) uint8 RGB, with a grid of half metres."""
    scale = _PIXELS / max(sheet.width, sheet.height)
    size = max(round(sheet.width * scale) + 90, 560), round(sheet.height * scale) + 110

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        axes.set_aspect("equal")
        axes.set(xlim=(0.0, sheet.width), ylim=(0.0, sheet.height), xlabel="m", ylabel="m")
        axes.set(xticks=np.arange(0.0, sheet.width, 0.5), yticks=np.arange(0.0, sheet.height, 0.5))
        axes.set_title(f"{title}\ngrid 0.5 m; black: white edge lines; amber: yellow centre line; arrow: start")
        lines = ((sheet.left, "black"), (sheet.right, "black"), (sheet.centre, "#cd9600"))
        for line, colour in lines if sheet.two_lanes else lines[:2]:
            axes.plot(*line.T, color=colour, linewidth=2.5)
        axes.plot(*sheet.lane[::2].T, ".", color=SERIES[0], markersize=4)
        across = np.stack((sheet.left, sheet.right))[:, :-1:_PER_METRE]
        axes.plot(*np.moveaxis(across, 2, 0), color="#bebebe", linewidth=1)
        ahead = 0.35 * sheet.lane_width * (sheet.lane[1] - sheet.lane[0]) / np.hypot(*(sheet.lane[1] - sheet.lane[0]))
        side = np.array((-ahead[1], ahead[0]))
        axes.fill(*(sheet.lane[0] + np.array([1.6 * ahead, side, -side])).T, color=SERIES[0])

    return draw_figure(*size, draw)
