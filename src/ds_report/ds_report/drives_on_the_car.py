# SPDX-License-Identifier: Apache-2.0
"""Writes proposed drives for a person: roads to tape out, what to set, and a table to fill in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ds_analysis.common.statistics import Array
from ds_analysis.real.proposal import ProposedDrive
from ds_analysis.real.records import COLUMNS, FOLDER, OPTIONAL
from ds_base.bounded_tables import csv_text
from ds_base.figures import draw_figure
from ds_base.folder_files import write_whole
from ds_base.palette import SERIES
from ds_road import Road
from ds_road.geometry import arc_lengths
from ds_sim.camera.encodings import png
from ds_sim.conditions.model import FIELDS
from ds_sim.conditions.text import format_3sf

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TO_FILL = "outcomes.csv"
SPACING = 0.1
"""Distance of points to tape out, m at the car's size; chosen: on the narrowest bend tape covers the error, 5 mm."""
_PER_METRE = round(1 / SPACING)
_MARGIN = 0.25
"""m at the car's size around the road, so that the grid's origin lies beside it."""
_PIXELS = 900
LINES = ("centre_line", "left_edge", "right_edge", "lane_centre")
_HOW = (
    "Tape each road out by its drawing or its CSV (metres on the floor, origin at the lower left), set the conditions, "
    "start at the arrow in the marked lane, and let the network drive once. The drive fails if the middle of the car "
    "leaves the lane, or if it stops. Drive the tests in this order and leave none out: they were drawn at random, and "
    "outcomes certify something only up to the first one that is missing. Then fill in `outcomes.csv`."
)


@dataclass(frozen=True, kw_only=True, eq=False)
class RoadSheet:
    """A road at the car's size; the origin is the lower left corner of a rectangle around it, x right and y up, m.

    The four `LINES` have (n, 2) points at the (n,) stations along the centre line; no paint is on the lane's centre.
    """

    width: float
    height: float
    stations: Array
    lines: Sequence[Array]
    lane_width: float
    two_lanes: bool

    def csv(self) -> str:
        """The points, one row per station, in metres to the millimetre."""
        values = np.column_stack((self.stations, *self.lines))
        heads = ["station_m", *(f"{name}_{axis}_m" for name in LINES for axis in "xy")]
        return csv_text([heads, *([f"{value:.3f}" for value in row] for row in values)])


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
        lines=scaled,
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
        centre, left, right, lane = sheet.lines
        painted = ((left, "black"), (right, "black"), (centre, "#cd9600"))
        for line, colour in painted if sheet.two_lanes else painted[:2]:
            axes.plot(*line.T, color=colour, linewidth=2.5)
        axes.plot(*lane[::2].T, ".", color=SERIES[0], markersize=4)
        across = np.stack((left, right))[:, :-1:_PER_METRE]
        axes.plot(*np.moveaxis(across, 2, 0), color="#bebebe", linewidth=1)
        ahead = 0.35 * sheet.lane_width * (lane[1] - lane[0]) / np.hypot(*(lane[1] - lane[0]))
        side = np.array((-ahead[1], ahead[0]))
        axes.fill(*(lane[0] + np.array([1.6 * ahead, side, -side])).T, color=SERIES[0])

    return draw_figure(*size, draw)


def write_drives_to_do(folder: Path, number: int, drives: Sequence[ProposedDrive]) -> Path:
    """Write a round of at least one drive, numbered from 1 on; returns its folder, for a person to read and fill in."""
    place = folder / FOLDER / f"round_{number}"
    how = (
        f"Scale 1:{drives[0].scale:g}. {_HOW}" if drives[0].road else "Drive these tests, then fill in `outcomes.csv`."
    )
    lines = [f"# Drives on the car, round {number}", "", how, ""]
    for rank, drive in enumerate(drives, start=1):
        lines += [f"## {rank}. {drive.test_id}", ""]
        if drive.road is None:
            lines += [f"- {name}: {format_3sf(value)}" for name, value in drive.features.items()]
        else:
            sheet, stem = sheet_of(drive.road, drive.scale), f"{rank}_{drive.test_id}"
            title = f"{rank}. test {drive.test_id}, drive in the {drive.road.lane} lane"
            write_whole(place / f"{stem}.png", png(draw_sheet(sheet, title)))
            write_whole(place / f"{stem}.csv", sheet.csv())
            size = f"{sheet.width:.1f} x {sheet.height:.1f} m"
            lines += [f"![road]({stem}.png)", "", f"- road: `{stem}.csv`, {size}; drive in the {drive.road.lane} lane"]
            settings = [f"- set {name} to {value}: {FIELDS[name].doc}" for name, value in drive.to_set.items()]
            lines += settings or ["- conditions: none to set, a dry road in even light"]
        said = ", ".join(f"{name} {outcome}" for name, outcome in drive.siblings.items())
        lines += [f"- in simulation: {said}; the car is expected to fail with {drive.probability:.0%}", ""]
    write_whole(place / "README.md", "\n".join(lines))
    to_fill = [[drive.test_id, *[""] * (len(COLUMNS) + len(OPTIONAL) - 1)] for drive in drives]
    write_whole(place / TO_FILL, csv_text([[*COLUMNS, *OPTIONAL], *to_fill]))
    return place
