"""Measures where a camera shows the lane, and crops two domains so that both show it alike."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ds_driver.sim2real.line_finder import find_lines, lane_borders
from ds_driver.sim2real.window import Sim2RealError, Window

SAMPLE = 300
"""Images in which lines are looked for; chosen: medians are then known within a pixel, in seconds."""
LOOKED_AT = 0.4
"""Share of the rows, from the top, that is not looked at; chosen: horizons of cars' cameras are above, with people,
lamps and buildings."""
LEAST_ROWS = 6
"""Rows with both lines that make an image one of a road; chosen: fewer are accidents of texture."""
LEAST_SHARE = 0.5
"""Share of images that must show a yellow line and a white one to its right; chosen: nine of ten do on the photographed
tracks, none in pictures of anything else."""
BOUND = 0.05
"""Largest difference of lane position, lane width and horizon between the domains, in widths and heights of the crop;
chosen from trials of ten minutes: lines stayed with 0.05, and moved with 0.10."""
LEAST_KEPT = 0.6
"""Least share of the simulator's view that is kept without a warning; chosen: both lines and 20 m of road are in it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LanePosition:
    """Where the lane is in a picture, as shares of its width and height.

    Attributes:
        yellow: column of the yellow line at the bottom.
        white: column of the white line at the bottom; more than 1 if it leaves the picture before.
        horizon: row where both lines meet; negative above the picture.
    """

    yellow: float
    white: float
    horizon: float

    @property
    def width(self) -> float:
        """Return the width of the lane at the bottom."""
        return self.white - self.yellow

    def difference(self, other: LanePosition) -> float:
        """Return the largest difference in lane position, lane width and horizon."""
        centre = (self.yellow + self.white - other.yellow - other.white) / 2
        return max(abs(centre), abs(self.width - other.width), abs(self.horizon - other.horizon))

    def __str__(self) -> str:
        return f"yellow line at {self.yellow:.2f}, white at {self.white:.2f}, horizon at {self.horizon:.2f}"


@dataclass(frozen=True, slots=True, kw_only=True)
class LaneView:
    """Lines of the lane in the images of one camera, in the median over the images: column = slope * row + start, px.

    Attributes:
        yellow: slope and start of the line to the left of the lane.
        white: slope and start of the line to its right.
        share: share of the images that show both.
        rows: rows of the images.
        columns: columns of the images.
    """

    yellow: tuple[float, float]
    white: tuple[float, float]
    share: float
    rows: int
    columns: int

    @property
    def horizon(self) -> float:
        """Return the row at which both lines meet, px."""
        return (self.white[1] - self.yellow[1]) / (self.yellow[0] - self.white[0])

    def at(self, row: float) -> tuple[float, float]:
        """Return the columns of both lines at a row."""
        return self.yellow[0] * row + self.yellow[1], self.white[0] * row + self.white[1]

    def seen_through(self, window: Window) -> LanePosition:
        """Return where the lane is in a window."""
        yellow, white = self.at(window.bottom)
        width, height = window.right - window.left, window.bottom - window.top
        return LanePosition(
            yellow=(yellow - window.left) / width,
            white=(white - window.left) / width,
            horizon=(self.horizon - window.top) / height,
        )


def measure_lane(images: NDArray[np.uint8], what: str) -> LaneView:
    """Measure where images show the lane.

    Args:
        images: (n, rows, columns, 3) uint8 RGB.
        what: for messages, such as `photographs`.

    Raises:
        Sim2RealError: the images show nothing like a road.
    """
    chosen = np.unique(np.linspace(0, len(images) - 1, min(SAMPLE, len(images))).round().astype(int))
    borders = np.stack([lane_borders(find_lines(images[i])) for i in chosen])
    borders[:, : round(LOOKED_AT * images.shape[1])] = np.nan
    share = float((np.isfinite(borders).all(axis=2).sum(axis=1) >= LEAST_ROWS).mean())
    if share < LEAST_SHARE:
        raise Sim2RealError(
            f"the {what} show nothing like a lane: a yellow line with a white one to its right is in {share:.0%} of "
            f"them, expected {LEAST_SHARE:.0%}: drive in the right lane, and leave out other pictures"
        )
    lines = [_fit(borders[:, :, side]) for side in (0, 1)]
    rows, columns = images.shape[1:3]
    view = LaneView(yellow=lines[0], white=lines[1], share=share, rows=rows, columns=columns)
    yellow, white = view.at(rows)
    if not (white - yellow > 0.1 * columns and view.yellow[0] < view.white[0] and view.horizon < 0.9 * rows):
        raise Sim2RealError(
            f"the {what} show nothing like a lane: its lines, {view.seen_through(Window(0, rows, 0, columns))}, do not "
            "meet ahead of the car: drive in the right lane, and leave out other pictures"
        )
    return view


def _fit(columns: NDArray[np.float64]) -> tuple[float, float]:
    """Fit a straight line to the medians of (images, rows), once more without its worst fifth."""
    counts = np.isfinite(columns).sum(axis=0)
    rows = np.flatnonzero(counts >= max(2, 0.4 * counts.max()))
    medians = np.array([np.nanmedian(columns[:, row]) for row in rows])
    weights = np.sqrt(counts[rows])
    for _ in range(2):
        slope, start = np.polyfit(rows, medians, 1, w=weights) if len(rows) > 1 else (0.0, float(medians[0]))
        errors = np.abs(slope * rows + start - medians)
        kept = errors <= np.quantile(errors, 0.8)
        rows, medians, weights = rows[kept], medians[kept], weights[kept]
    return float(slope), float(start)


@dataclass(frozen=True, slots=True, kw_only=True)
class Match:
    """Crops that show the lane alike.

    Attributes:
        simulated: window in the simulator's images.
        real: window in the photographs.
        kept: share of the simulator's view that is left.
        positions: where the lane is, in simulated and real crops.
    """

    simulated: Window
    real: Window
    kept: float
    positions: tuple[LanePosition, LanePosition]

    @property
    def difference(self) -> float:
        """Return the largest difference between the domains; compare it with `BOUND`."""
        return self.positions[0].difference(self.positions[1])


def match_windows(simulated: LaneView, window: Window, real: LaneView) -> Match:
    """Find the crops with which photographs show the lane as a simulator does.

    For each bottom row of the photographs, one rectangle shows both lines and the horizon where the simulator's window
    has them. What of it lies outside the photographs is cut off in both domains. The row that keeps most is used.

    Args:
        simulated: lane in the simulator's images.
        window: rows and columns of the simulator's images that a network sees.
        real: lane in the photographs.

    Raises:
        Sim2RealError: no crop shows the lane alike.
    """
    wanted = simulated.seen_through(window)
    best: Match | None = None
    for bottom in range(real.rows, round(0.6 * real.rows), -1):
        yellow, white = real.at(bottom)
        width = (white - yellow) / wanted.width
        left = yellow - wanted.yellow * width
        top = (real.horizon - wanted.horizon * bottom) / (1.0 - wanted.horizon)
        height = bottom - top
        if width <= 0 or height <= 0:
            continue
        # What lies within the photographs, as shares of the rectangle.
        u0, u1 = max(0.0, -left / width), min(1.0, (real.columns - left) / width)
        v0 = max(0.0, -top / height)
        kept = (u1 - u0) * (1.0 - v0)
        if u1 <= u0 or v0 >= 1.0 or (best is not None and kept <= best.kept + 1e-9):
            continue
        try:
            windows = (
                _part(window.top, window.bottom, window.left, window.right, (u0, u1, v0)),
                _part(top, bottom, left, left + width, (u0, u1, v0)),
            )
        except Sim2RealError:
            continue
        positions = (simulated.seen_through(windows[0]), real.seen_through(windows[1]))
        best = Match(simulated=windows[0], real=windows[1], kept=kept, positions=positions)
    if best is None:
        raise Sim2RealError("no crop of the photographs shows the lane as the simulator does: mount the camera lower")
    return best


def _part(top: float, bottom: float, left: float, right: float, part: tuple[float, float, float]) -> Window:
    u0, u1, v0 = part
    return Window(
        top=round(top + v0 * (bottom - top)),
        bottom=round(bottom),
        left=round(left + u0 * (right - left)),
        right=round(left + u1 * (right - left)),
    )
