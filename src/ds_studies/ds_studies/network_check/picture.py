# SPDX-License-Identifier: Apache-2.0
"""Draws what a network sees on each simulator, and its steering beside the autopilot's."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ds_base.figures import WIDTH, draw_figure, short_name
from ds_base.palette import SERIES
from ds_driver.networks.network_driver import load_pilot
from ds_sim.simulator import FRAME_TIME
from ds_studies.network_check.diagnosis import NetworkCheck
from ds_studies.network_check.recording import AutopilotDrives

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FRAME = 15
"""Number of the image that is shown, of each simulator; chosen: 6 s after the start, in the first bend."""
_ROW = 190
"""Pixels of a simulator's row."""


def draw_check(check: NetworkCheck, recordings: Sequence[AutopilotDrives]) -> NDArray[np.uint8]:
    """Draw for each simulator its camera, what the network sees, and both steerings, as (rows, columns, 3) RGB."""
    pilot = load_pilot(check.driver)

    def draw(figure: Figure) -> None:
        rows = figure.subplots(len(recordings), 3, squeeze=False, width_ratios=(1, 1, 1.6))
        for (camera, network, chart), one in zip(rows, recordings, strict=True):
            frame = one.frames[min(FRAME, len(one.frames) - 1)]
            seen, colour = pilot.seen(frame)
            size = " x ".join(map(str, seen.shape[:2]))
            for axes, image, title in (
                (camera, frame.image, f"{short_name(one.simulator)}: its camera"),
                (network, seen, f"the network sees: {size}, {colour}"),
            ):
                axes.imshow(np.repeat(image, 3, axis=2) if image.shape[2] == 1 else image)
                axes.set_axis_off()
                axes.set_title(title)
            moments = np.arange(len(one.steering))
            chart.plot(moments, one.steering, color=SERIES[4], label="autopilot", linewidth=3, alpha=0.4)
            chart.plot(moments, check.steering[one.simulator], color=SERIES[0], label="network", linewidth=1)
            chart.set_title("steering, -1 left to +1 right")
            chart.legend(loc="upper right", ncols=2, fontsize=7)
        seconds = FRAME_TIME * (recordings[-1].frames[1].step - recordings[-1].frames[0].step)
        rows[-1][2].set_xlabel(f"image, every {seconds:g} s of four drives")

    return draw_figure(WIDTH, _ROW * len(recordings) + 20, draw)
