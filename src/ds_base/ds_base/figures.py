# SPDX-License-Identifier: Apache-2.0
"""Figures drawn by Matplotlib: the same values give the same bytes, whatever a user's settings are."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ds_base.folder_files import whole_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDTH = 1140
"""Pixels across a page of panels."""
_DPI = 100
_STYLE: dict[Any, Any] = {
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.titlelocation": "left",
    "axes.titlesize": 11,
    "font.size": 9,
    "grid.color": "#e1e1e1",
    "legend.frameon": False,
    "svg.hashsalt": "",  # names of its parts, which are random otherwise
    "text.parse_math": False,  # names of files and simulators may hold a $
}


def draw_figure(
    width: int, height: int, draw: Callable[[Figure], object], vector: Path | None = None
) -> NDArray[np.uint8]:
    """Draw a figure of so many pixels, (rows, columns, 3) uint8 RGB; `draw` adds everything to an empty one.

    With `vector`, the figure is written for papers, too, as this path with `.pdf` and with `.svg`.
    """
    # The import takes half a second, and most commands draw nothing.
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_STYLE)
        # Older versions of Matplotlib cut off fractions of pixels: 4.6 inches are 459.99.
        figure = Figure(((width + 1e-9) / _DPI, (height + 1e-9) / _DPI), _DPI, layout="constrained")
        canvas = FigureCanvasAgg(figure)
        draw(figure)
        canvas.draw()
        if vector is not None:
            for suffix, date in ((".pdf", "CreationDate"), (".svg", "Date")):
                with whole_file(vector.with_suffix(suffix)) as partial:
                    figure.savefig(partial, format=suffix[1:], metadata={date: None})
    return np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3])


def short_name(name: str) -> str:
    """Name of at most 24 characters, such as the labels of an axis have room for: the middle of longer ones is cut."""
    return name if len(name) <= 24 else f"{name[:11]}..{name[-11:]}"
