# SPDX-License-Identifier: Apache-2.0
"""One HTML file that answers an owner of a car: does the driver leave its lane on the recorded track, and where?"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ds_analysis.siblings.track_answer import TrackAnswer
from ds_base.figures import WIDTH, draw_figure
from ds_base.palette import ASPHALT, CENTRE_LINE, EDGE_LINE, FAIL, INK, SERIES
from ds_recording.sibling.recorded_drive import RecordedDrive
from ds_report.pages import data_address, write_page
from ds_sim.registry import SimulatorName

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PHOTOGRAPHS, APART = 3, 10.0
"""Places of failures with a photograph, and how far they are apart, road metres; chosen: a glance, half a second."""


def write_track_page(path: Path, answer: TrackAnswer, drive: RecordedDrive, facts: Mapping[str, str]) -> Path:
    """Write the page, with rows of a table about the recording; the same answer gives the same bytes."""
    columns = [(who, where) for who, where in answer.drives if who == answer.driver or where == answer.recording]
    rows = [
        (
            f"{_start(drive, road.lane_centre[0]):.0f} to {_start(drive, road.lane_centre[-1]):.0f}",
            "left its lane" if answer.recorded[index] else "in its lane",
            ["no verdict" if (one := answer.drives[key][index]) is None else one.outcome.words for key in columns],
        )
        for index, road in enumerate(answer.roads)
    ]
    places: list[NDArray[np.float64]] = []
    for place in _failures(answer, answer.recording):
        if all(np.hypot(*(place - other)) > APART for other in places):
            places.append(place)
    across, up = np.ptp(drive.lane.points, axis=0) + 3.0 * drive.lane_width
    height = int(np.clip(WIDTH / 2 * up / across, 200, 600)) + 60
    return write_page(
        path,
        "track.html.j2",
        answer=answer,
        facts=facts,
        map=data_address(draw_figure(WIDTH, height, lambda figure: _draw(figure, answer, drive))),
        columns=[f"{who} on {_short(where)}" for who, where in columns],
        rows=rows,
        photographs=[
            (
                f"{_start(drive, place):.0f} road metres along the track",
                data_address(drive.photograph(_nearest(drive.poses, place))),
            )
            for place in places[:PHOTOGRAPHS]
        ],
    )


def _short(simulator: SimulatorName) -> str:
    return "the twin" if simulator.base == "donkey" else "the recording"


def _failures(answer: TrackAnswer, simulator: SimulatorName) -> list[NDArray[np.float64]]:
    """Where the driver's failures end, x and y, road metres."""
    drives = answer.drives[answer.driver, simulator]
    return [one.trajectory[-1, :2] for one in drives if one is not None and one.outcome.is_failure]


def _start(drive: RecordedDrive, place: NDArray[np.float64]) -> float:
    """Station of the lane nearest to a place, road metres."""
    return float(drive.lane.stations[_nearest(drive.lane.points, place)])


def _nearest(places: NDArray[np.float64], place: NDArray[np.float64]) -> int:
    return int(np.argmin(np.hypot(*(places[:, :2] - place[:2]).T)))


def _draw(figure: Figure, answer: TrackAnswer, drive: RecordedDrive) -> None:
    for axes, simulator in zip(figure.subplots(1, 2), (answer.recording, answer.twin), strict=True):
        failures, judged = answer.failures(answer.driver, simulator)
        axes.set_title(f"{answer.driver} on {_short(simulator)}: fails on {failures} of {judged}")
        _draw_track(axes, drive)
        for one in answer.drives[answer.driver, simulator]:
            if one is not None:
                axes.plot(*one.trajectory[:, :2].T, color=SERIES[0], linewidth=0.8)
        places = _failures(answer, simulator)
        if places:
            axes.plot(*np.array(places).T, "X", color=FAIL, markersize=11, markeredgecolor=INK, linestyle="none")
        axes.set_aspect("equal", "datalim")
        axes.set(xlabel="x, road metres", ylabel="y, road metres")


def _draw_track(axes: Axes, drive: RecordedDrive) -> None:
    """The driven lane and the one beside it, with a number every 20 road metres, and what was recorded."""
    lane, width = drive.lane, drive.lane_width
    left, middle, right = (lane.beside(offset).points for offset in (-1.5 * width, -0.5 * width, 0.5 * width))
    lines = [np.vstack((line, line[:1])) if lane.closed else line for line in (left, middle, right)]
    axes.fill(*np.vstack((lines[0], lines[2][::-1])).T, color=ASPHALT, linewidth=0)
    for line, colour in zip(lines, (EDGE_LINE, CENTRE_LINE, EDGE_LINE), strict=True):
        axes.plot(*line.T, color=colour, linewidth=1)
    axes.plot(*drive.poses[:, :2].T, ".", color="#c8c8c8", markersize=1)
    for index in range(0, len(lane.points), 20):
        axes.annotate(f"{lane.stations[index]:.0f}", lane.points[index], fontsize=7, color=EDGE_LINE, ha="center")
