# SPDX-License-Identifier: Apache-2.0
"""Pages about a recording: where the car was, and whether a driver leaves its lane on the recorded track, and where."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_analysis.siblings.track_answer import TrackAnswer
from ds_base.figures import WIDTH, draw_figure
from ds_base.palette import ASPHALT, CENTRE_LINE, EDGE_LINE, FAIL, INK, SERIES
from ds_recording.floor_camera import FloorCamera
from ds_recording.locate import SolvedStretch
from ds_recording.located import Located
from ds_recording.motion import moved
from ds_recording.odometry import summary
from ds_recording.recording import Views
from ds_recording.sibling.recorded_drive import RecordedDrive
from ds_recording.track import Track
from ds_report.pages import data_address, write_page
from ds_sim.registry import SimulatorName

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PICTURES, ACROSS = 12, 4
"""Pictures with fitted lines, and how many lie beside each other."""
SHOWN = (0.3, 6.0)
"""Distance ahead of the car within which lines are drawn, lane widths."""


def write_recording_page(path: Path, views: Views, located: Located, fit: SolvedStretch) -> Path:
    """Write the page of a stretch's images, its solution, and the result of that."""
    about = located.about
    stretch, camera = about["stretch"], located.camera
    spread = f" +- {camera.focal_std:.1f}" if camera.focal_std else ""
    focal = f"{camera.focal_px[0]:.1f} and {camera.focal_px[1]:.1f}{spread} px"
    rows = {
        "Recording": f"{about['source']} ({about['kind']}, {about['frames']} images)",
        "Used": f"images {stretch['first']} to {stretch['last']}, of which {stretch['located']:.1%} are located",
        "Track": f"{located.track.length:.2f} m of {'closed track' if about['closed'] else 'road, not closed'}, "
        f"lanes of {about['lane_width_m']:g} m",
        "Camera": f"{about['calibration']}: focal lengths {focal}, "
        f"height {camera.height_m:.3g} m, pitch {np.degrees(camera.pitch_rad or 0.0):.1f} degrees",
        "Lines": f"are {1000 * about['median_line_residual_m']:.3g} mm from where they should be, in the median",
        "Motion": summary(about),
        "Steering": _steering(about["steering"]),
    }

    def drawn(height: int, draw: Callable[[Figure, Located, SolvedStretch], None]) -> str:
        return data_address(draw_figure(WIDTH, height, lambda figure: draw(figure, located, fit)))

    lines = "Fitted lines drawn in: yellow is the centre line, white the edges; grey ones are not located."
    sheet = contact_sheet(views, located.camera, located.lane_width, fit)
    return write_page(
        path,
        "recording.html.j2",
        source=about["source"],
        rows=rows,
        pictures=[
            (
                "The track from above",
                "Driven line on the road; crosses are images that could not be located.",
                drawn(620, _from_above),
            ),
            ("Over time", "What lines and motion leave unexplained, and what was driven.", drawn(760, _over_time)),
            ("Pictures", lines, data_address(sheet)),
        ],
    )


def _steering(steering: dict[str, float] | None) -> str:
    if steering is None:
        return "explains too little of the motion to say how the car follows it"
    return (
        f"full steering turns the car with {abs(steering['gain_per_m']):.3g} 1/m after {steering['delay_s']:.2f} s, "
        f"{steering['explained']:.0%} of its turning is explained by it"
    )


def _from_above(figure: Figure, located: Located, fit: SolvedStretch) -> None:
    axes = figure.subplots()
    for offset, colour in ((-1.0, "#888888"), (0.0, "#c09000"), (1.0, "#888888")):
        line = located.track.beside(offset * located.lane_width).points
        line = np.vstack((line, line[:1])) if located.track.closed else line
        axes.plot(*line.T, color=colour, linewidth=1)
    axes.plot(located.column("x_m"), located.column("y_m"), ".", color=SERIES[0], markersize=2)
    lost = fit.solution.poses[~fit.located, :2] * located.lane_width
    axes.plot(*lost.T, "x", color=SERIES[1], markersize=4)
    axes.set(xlabel="x, m", ylabel="y, m")
    axes.set_aspect("equal", "datalim")


def _over_time(figure: Figure, located: Located, fit: SolvedStretch) -> None:
    first, second, third, fourth = figure.subplots(4, 1, sharex=True)
    times = fit.evidence.times
    first.plot(times, fit.solution.residuals * located.lane_width, ".", markersize=2, color=SERIES[0])
    first.set(title="Median distance of painted lines from the fitted ones", ylabel="m")
    second.plot(times, fit.solution.agree, ".", markersize=2, color=SERIES[2])
    second.set(title="Share of an image's line points that agree", ylim=(0, 1.05))
    time = located.column("time_s")
    offset, std = located.column("lateral_m"), located.column("std_lateral_m")
    third.fill_between(time, offset - 2 * std, offset + 2 * std, color="#cccccc")
    third.plot(time, offset, linewidth=1, color=SERIES[0])
    third.set(title="Offset to the right of the road's centre line, with two standard deviations", ylabel="m")
    fourth.plot(time, located.column("speed_mps"), linewidth=1, color=SERIES[1])
    fourth.set(title="Speed", ylabel="m/s", xlabel="s")


def contact_sheet(views: Views, camera: FloorCamera, lane_width: float, fit: SolvedStretch) -> NDArray[np.uint8]:
    """Pictures at even times with the fitted lines, (rows, columns, 3) uint8 RGB."""
    chosen = np.linspace(0, len(views.images) - 1, PICTURES + 2)[1:-1].round().astype(int)
    track = fit.solution.track.resampled(0.1)
    drawn = [drawn_in(views.images[i], int(i), camera, lane_width, fit, track) for i in chosen]
    rows = [np.hstack(drawn[i : i + ACROSS]) for i in range(0, PICTURES, ACROSS)]
    return np.ascontiguousarray(np.vstack(rows))


def drawn_in(
    image: NDArray[np.uint8], frame: int, camera: FloorCamera, lane_width: float, fit: SolvedStretch, track: Track
) -> NDArray[np.uint8]:
    """One picture with the fitted lines, `WIDTH` / `ACROSS` columns wide; `track` has steps of 0.1 lane widths."""
    width = WIDTH // ACROSS
    height = round(image.shape[0] * width / image.shape[1])
    large = np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_CUBIC), np.uint8)
    scaled = camera.resized(width, height).scaled(1.0 / lane_width)
    start = int(np.searchsorted(track.stations, fit.solution.along[frame] % max(track.length, 1e-9)))
    index = start + np.arange(-10, round(1.3 * SHOWN[1] / 0.1))
    index = index % len(track.points) if track.closed else index[(index >= 0) & (index < len(track.points))]
    good = bool(fit.located[frame])
    for offset, colour in ((0.0, (255, 210, 0)), (-1.0, (255, 255, 255)), (1.0, (255, 255, 255))):
        floor = moved(track.beside(offset).points[index], fit.solution.poses[frame])
        pixels, valid = scaled.project(floor)
        valid &= (floor[:, 0] > SHOWN[0]) & (floor[:, 0] < SHOWN[1])
        for i in np.flatnonzero(valid[1:] & valid[:-1]):
            ends = [tuple(int(v) for v in np.clip(16 * pixels[j], -(2**24), 2**24)) for j in (i, i + 1)]
            for thickness, shade in ((3, (0, 0, 0)), (1, colour if good else (128, 128, 128))):
                cv2.line(large, ends[0], ends[1], shade, thickness, cv2.LINE_AA, 4)
    cv2.putText(large, str(frame), (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 60, 60), 1, cv2.LINE_AA)
    return large


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
