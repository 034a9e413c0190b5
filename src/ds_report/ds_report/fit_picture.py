# SPDX-License-Identifier: Apache-2.0
"""Draws a fit: some windows as measured and as fitted, and the residuals."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ds_base.figures import WIDTH, draw_figure
from ds_base.folder_files import write_whole
from ds_base.palette import SERIES
from ds_sim.camera.encodings import png
from ds_sim.simulator import FRAME_TIME
from ds_twin_donkey.fit import TwinFit
from ds_twin_donkey.logs import CHANNELS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
    for index, name in enumerate(CHANNELS):
        left = (fit.measured - fit.fitted)[..., index].ravel()
        left = left[np.isfinite(left)]
        if left.size and fit.rms[name] > 0.0:
            height, _ = np.histogram(left / fit.rms[name], edges, density=True)
            axes.plot(0.5 * (edges[1:] + edges[:-1]), height, color=SERIES[index], label=f"{name}: {fit.rms[name]:.2g}")
    axes.set(title="Measured minus fitted, over its rms", xlabel="rms", ylabel="density")
    axes.legend(loc="upper left")
