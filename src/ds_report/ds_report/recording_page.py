# SPDX-License-Identifier: Apache-2.0
"""One HTML file that shows a located recording: the track from above, residuals, pictures with fitted lines."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_base.figures import WIDTH, draw_figure
from ds_base.palette import SERIES
from ds_recording.floor_camera import FloorCamera
from ds_recording.locate import SolvedStretch
from ds_recording.located import Located
from ds_recording.motion import moved
from ds_recording.odometry import summary
from ds_recording.recording import Views
from ds_recording.track import Track
from ds_report.pages import data_address, write_page

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
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
