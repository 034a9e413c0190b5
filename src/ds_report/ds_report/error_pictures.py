# SPDX-License-Identifier: Apache-2.0
"""Draws errors: of a driver on recorded images, over density, time and the worst images, and of the fit of a twin."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ds_analysis.common.statistics import Array
from ds_analysis.paper.open_loop import WORST, OpenLoopAnswers
from ds_analysis.paper.steering_error_stats import EDGES, density, pooled_errors
from ds_base.figures import WIDTH, draw_figure
from ds_base.folder_files import write_whole
from ds_base.palette import SERIES
from ds_sim.camera.encodings import png
from ds_sim.simulator import FRAME_TIME

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

    from ds_twin_donkey.fit import TwinFit

SHOWN = 4
"""Largest number of recordings drawn over time; chosen: fits on a screen."""


def draw_errors(title: str, answers: Sequence[OpenLoopAnswers], path: Path) -> None:
    """Write a picture of the steering errors on every recording as PNG, and beside it as PDF and SVG."""
    errors, shown = pooled_errors(answers), answers[:SHOWN]
    panels = [(330, partial(_densities, errors))] if errors else []
    panels += [(230, partial(_over_time, one)) for one in shown if len(one.index) > 1]
    panels += [(160, partial(_worst, one)) for one in shown if one.worst]

    def draw(figure: Figure) -> None:
        figure.suptitle(title)
        if not panels:
            return
        parts = figure.subfigures(len(panels), squeeze=False, height_ratios=[height for height, _ in panels])
        for part, (_, panel) in zip(parts[:, 0], panels, strict=True):
            panel(part)

    write_whole(path, png(draw_figure(WIDTH, 40 + sum(height for height, _ in panels), draw, path)))


def _densities(errors: dict[str, Array], figure: SubFigure) -> None:
    together = np.concatenate(list(errors.values()))
    # Shows 99.5% of the errors; the table has the largest one.
    reach = float(np.clip(1.2 * np.quantile(np.abs(together), 0.995), 0.1, 2.0))
    axes = figure.subplots()
    axes.axvline(0.0, color="#969696", linewidth=1)
    for number, (group, values) in enumerate(errors.items()):
        label = f"{group}: mean size {np.abs(values).mean():.3f}, {values.size} images"
        axes.stairs(density(values), EDGES, color=SERIES[number % len(SERIES)], linewidth=1.5, label=label)
    axes.set(title="Density of the steering errors", xlabel="answered minus recorded: left < 0 < right")
    axes.set(xlim=(-reach, reach), ylim=(0.0, None))
    axes.legend(loc="upper left")


def _over_time(answers: OpenLoopAnswers, figure: SubFigure) -> None:
    """Draw steering over the image number, since a recording's clock may differ from the drive's."""
    axes = figure.subplots()
    axes.plot(answers.index, answers.recorded, color="black", linewidth=1.5, label="recorded")
    axes.plot(answers.index, answers.answered, color=SERIES[1], linewidth=1, label="answered")
    title = answers.name if answers.name == answers.group else f"{answers.name} ({answers.group})"
    axes.set(title=title, xlabel="image", xlim=(answers.index[0], answers.index[-1]), ylim=(-1.05, 1.05))
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)


def _worst(answers: OpenLoopAnswers, figure: SubFigure) -> None:
    """Draw the images with the largest errors, with both steerings as needles: black recorded, red answered."""
    figure.suptitle(f"Largest errors in {answers.name}: black recorded, red answered", x=0.01, ha="left")
    places = figure.subplots(1, WORST)
    for axes in places:
        axes.axis("off")
    for axes, (frame, value) in zip(places, answers.worst, strict=False):
        assert frame.image is not None and frame.steering is not None
        rows, columns = frame.image.shape[:2]
        axes.imshow(frame.image)
        for steering, colour, width in ((frame.steering, "white", 4), (frame.steering, "black", 2), (value, "red", 2)):
            turn = steering * np.pi / 3  # full lock is drawn 60 degrees to the side
            tip = columns / 2 + 0.6 * rows * np.sin(turn), rows - 0.6 * rows * np.cos(turn)
            axes.plot((columns / 2, tip[0]), (rows, tip[1]), color=colour, linewidth=width)
        axes.set(xlim=(0, columns), ylim=(rows, 0))
        axes.set_title(f"{frame.index}: {frame.steering:+.2f}, {value:+.2f}", fontsize=8)


MAX_WINDOWS = len(SERIES)
"""Number of windows drawn; chosen: as many as can be distinguished."""


def draw_fit(fit: TwinFit, path: Path) -> None:
    """Write PNG, PDF and SVG of paths, speed and yaw rate of some windows, and histograms of residuals over rms."""
    chosen = np.unique(np.linspace(0, fit.windows - 1, MAX_WINDOWS).round().astype(int))
    frames = fit.measured.shape[1]
    measured, origins = fit.measured[chosen], fit.fitted[chosen, :1, :2]
    # The last window may be shorter than the others: nothing is measured in the remainder.
    fitted = np.where(np.isfinite(measured).any(axis=2, keepdims=True), fit.fitted[chosen], np.nan)

    def draw(figure: Figure) -> None:
        figure.suptitle(f"Dots measured, lines fitted: {len(chosen)} of {fit.windows} windows")
        ways, speeds, yaw_rates, residuals = figure.subplots(2, 2).ravel()
        for k in range(len(chosen)):
            times = (k * frames + np.arange(frames)) * FRAME_TIME
            for values, style in ((measured[k], "."), (fitted[k], "-")):
                drawn = {"color": SERIES[k], "markersize": 3, "linewidth": 1}
                ways.plot(*(values[:, :2] - origins[k]).T, style, **drawn)
                speeds.plot(times, values[:, 3], style, **drawn)
                yaw_rates.plot(times, values[:, 4], style, **drawn)
        ways.set(title="Paths from the start of each window", xlabel="x, m", ylabel="y, m")
        ways.set_aspect("equal", "datalim")
        speeds.set(title="Speed, windows side by side", xlabel="s", ylabel="m/s")
        yaw_rates.set(title="Yaw rate, windows side by side", xlabel="s", ylabel="rad/s")
        _histograms(fit, residuals)

    write_whole(path, png(draw_figure(WIDTH, 836, draw, path)))


def _histograms(fit: TwinFit, axes: Axes) -> None:
    edges = np.linspace(-4.0, 4.0, 33)
    axes.plot(edges, np.exp(-0.5 * edges**2) / np.sqrt(2.0 * np.pi), color="#aaaaaa", linewidth=3, label="normal")
    for index, (name, rms) in enumerate(fit.rms.items()):
        left = (fit.measured - fit.fitted)[..., index].ravel()
        left = left[np.isfinite(left)]
        if left.size and rms > 0.0:
            height, _ = np.histogram(left / rms, edges, density=True)
            axes.plot(0.5 * (edges[1:] + edges[:-1]), height, color=SERIES[index], label=f"{name}: {rms:.2g}")
    axes.set(title="Measured minus fitted, over its rms", xlabel="rms", ylabel="density")
    axes.legend(loc="upper left")
