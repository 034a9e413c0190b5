# SPDX-License-Identifier: Apache-2.0
"""Finds the lane's lines in images by colour and width alone, and crops two domains so that both show the lane alike.

Nothing here is trained, so it cannot learn the mistakes of a generator; `docs/sim2real.md` shows it on photographs.
"""

from __future__ import annotations

from dataclasses import dataclass
from operator import itemgetter
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_driver.sim2real.generator import Sim2RealError, Window

WIDEST = 0.14
"""Widest line, in widths of the image; chosen: tape on the photographed tracks is up to 0.12 wide at the bottom."""
MIN_YELLOW = 20.0
"""Least surplus of yellowness (a + b of CIE Lab) of a line; chosen on photographs: wood reaches 15, worn tape 25."""
YELLOW = (1.0, 1.0)
"""Weights of a and b of CIE Lab in yellowness; red and orange have as much of it."""
YELLOW_ITSELF = 18.0
"""Least yellowness of the line itself; chosen on photographs: beige on blue has a surplus, but hardly any itself."""
MIN_WHITE = 20.0
"""Least surplus of whiteness (L minus chroma of CIE Lab) of a line; chosen: reflections reach 25, lines 25 to 50."""
HALO = 0.03
"""Width of the rim of a yellow line that is not taken for white, in image widths; chosen: blur of photographs."""
SMALLEST = 6
"""Fewest pixels of a line's visible piece in an image of 160 columns; chosen: smaller ones are texture."""
REFERENCE_COLUMNS = 160

Mask = NDArray[np.bool_]
SAMPLE = 300
"""Images in which lines are looked for; chosen: medians are then known within a pixel, in seconds."""
LOOKED_AT = 0.4
"""Share of the rows, from the top, that is not looked at; chosen: horizons of cars' cameras are above."""
LEAST_ROWS = 6
"""Rows with both lines that make an image one of a road; chosen: fewer are accidents of texture."""
LEAST_SHARE = 0.5
"""Share of images that must show a yellow line and a white one to its right; chosen: nine of ten do on real tracks."""
HEIGHTS = np.linspace(0.4, 0.95, 12)
"""Heights, as shares of a crop, at which the lines of both domains are compared; chosen: curves are farther up."""
BOUND = 0.05
"""Largest difference of a line's place between the domains, in widths of the crop, in the mean over `HEIGHTS`; chosen
from trials of ten minutes: lines stayed with 0.05, and moved with 0.10."""
LEAST_HEIGHTS = 8
"""Heights at which a line must be known in both domains; chosen: two thirds of them."""
HIGHEST_TOP, LEAST_HEIGHT = 0.7, 0.25
"""Lowest top row and least height of a crop, as shares of a photograph's rows; chosen: less shows hardly any road."""
LEAST_KEPT = 0.6
"""Least share of the simulator's view that is kept without a warning; chosen: both lines and 20 m of road are in it."""


class Lines(NamedTuple):
    """Pixels, (rows, columns), of the yellow line to the left of the lane, and of the white edges of the road."""

    yellow: Mask
    white: Mask


def find_lines(image: NDArray[np.uint8], colour: tuple[float, float] = YELLOW) -> Lines:
    """Find the lines in an image, (rows, columns, 3) uint8 RGB; the left one by weights of a and b of CIE Lab."""
    lab = cv2.cvtColor(image.astype(np.float32) / 255.0, cv2.COLOR_RGB2LAB)
    lightness, a, b = lab[..., 0], lab[..., 1], lab[..., 2]
    side = max(3, round(WIDEST * image.shape[1])) | 1
    smallest = round(SMALLEST * (image.shape[1] / REFERENCE_COLUMNS) ** 2)
    yellowness = colour[0] * a + colour[1] * b
    yellow = _without_specks((_ridges(yellowness, side) > MIN_YELLOW) & (yellowness > YELLOW_ITSELF), smallest)
    rim = round(HALO * image.shape[1]) | 1
    near_yellow = cv2.dilate(yellow.astype(np.uint8), np.ones((rim, rim), np.uint8)) > 0
    white = (_ridges(lightness - np.hypot(a, b), side) > MIN_WHITE) & ~near_yellow
    return Lines(yellow, _without_specks(white, smallest))


def lane_borders(lines: Lines) -> NDArray[np.float64]:
    """Columns of the yellow line and of the next white one to its right, (rows, 2); NaN where there is none.

    A run of pixels that touches the side of the image has no middle, so it does not count.
    """
    borders = np.full((lines.yellow.shape[0], 2), np.nan)
    for row, (yellow, white) in enumerate(zip(lines.yellow, lines.white, strict=True)):
        middles = _run_middles(yellow)
        if not middles.size:
            continue
        borders[row, 0] = middles[-1]
        edges = _run_middles(white)
        edges = edges[edges > middles[-1]]
        if edges.size:
            borders[row, 1] = edges[0]
    return borders


def _ridges(values: NDArray[np.float32], side: int) -> NDArray[np.float32]:
    """Height of what is narrower than `side` pixels above what is around it."""
    reach = side // 2
    padded = cv2.copyMakeBorder(values, reach, reach, reach, reach, cv2.BORDER_REPLICATE)
    opened = cv2.morphologyEx(padded, cv2.MORPH_TOPHAT, np.ones((side, side), np.uint8))
    return np.asarray(opened[reach:-reach, reach:-reach], np.float32)


def _without_specks(mask: Mask, smallest: int) -> Mask:
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    large = np.zeros(count, np.bool_)
    large[1:] = stats[1:, cv2.CC_STAT_AREA] >= smallest
    return np.asarray(large[labels], np.bool_)


def _run_middles(row: Mask) -> NDArray[np.float64]:
    """Middles of the runs of a row that do not touch its ends."""
    change = np.flatnonzero(np.diff(row, prepend=False, append=False))
    begins, ends = change[::2], change[1::2]
    inside = (begins > 0) & (ends < row.size)
    return (begins[inside] + ends[inside] - 1) / 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class LanePosition:
    """Columns of both lines at the bottom of a picture, and the row where they meet, as shares of its width and height.

    A line that leaves the picture before is beyond 1; a horizon above it is negative.
    """

    yellow: float
    white: float
    horizon: float

    def __str__(self) -> str:
        return f"yellow line at {self.yellow:.2f}, white at {self.white:.2f}, horizon at {self.horizon:.2f}"


@dataclass(frozen=True, slots=True, kw_only=True)
class LaneView:
    """Lines of the lane in the median over images of one camera: column = slope * row + start, px."""

    yellow: tuple[float, float]  # slope and start of the line to the left of the lane, as `white` to its right
    white: tuple[float, float]
    share: float  # of the images that show both
    rows: int  # of the images, as `columns`
    columns: int
    medians: NDArray[np.float64]  # (rows, 2) columns of both lines, not straightened; NaN where they are seldom seen

    @property
    def horizon(self) -> float:
        """Return the row at which both lines meet, px."""
        return (self.white[1] - self.yellow[1]) / (self.yellow[0] - self.white[0])

    def at(self, row: float) -> tuple[float, float]:
        """Return the columns of both lines at a row."""
        return self.yellow[0] * row + self.yellow[1], self.white[0] * row + self.white[1]

    def medians_in(self, window: Window) -> NDArray[np.float64]:
        """Return the medians at `HEIGHTS` of a window, in its widths."""
        rows = window.top + HEIGHTS * (window.bottom - window.top)
        medians = self.medians[rows.astype(int).clip(0, self.rows - 1)]
        return (medians - window.left) / (window.right - window.left)

    def seen_through(self, window: Window) -> LanePosition:
        """Return where the lane is in a window."""
        yellow, white = self.at(window.bottom)
        width, height = window.right - window.left, window.bottom - window.top
        return LanePosition(
            yellow=(yellow - window.left) / width,
            white=(white - window.left) / width,
            horizon=(self.horizon - window.top) / height,
        )


def lane_difference(views: tuple[LaneView, LaneView], windows: tuple[Window, Window]) -> float:
    """Compare the medians of both lines in two windows: the larger mean difference, in widths; see `BOUND`."""
    apart = np.abs(views[0].medians_in(windows[0]) - views[1].medians_in(windows[1]))
    if not np.isfinite(apart).any(axis=0).all():
        return 1.0
    return float(np.nanmean(apart, axis=0).max())


def evenly(count: int, limit: int) -> NDArray[np.int64]:
    """Choose at most `limit` of `count` items, evenly; return their indices."""
    return np.unique(np.linspace(0, count - 1, min(count, limit)).round().astype(np.int64))


def measure_lane(images: NDArray[np.uint8], what: str) -> LaneView:
    """Measure where images, (n, rows, columns, 3) uint8 RGB and called `what`, show the lane; or a Sim2RealError."""
    borders = np.stack([lane_borders(find_lines(images[i])) for i in evenly(len(images), SAMPLE)])
    borders[:, : round(LOOKED_AT * images.shape[1])] = np.nan
    share = float((np.isfinite(borders).all(axis=2).sum(axis=1) >= LEAST_ROWS).mean())
    if share < LEAST_SHARE:
        raise Sim2RealError(
            f"the {what} show nothing like a lane: a yellow line with a white one to its right is in {share:.0%} of "
            f"them, expected {LEAST_SHARE:.0%}: drive in the right lane, and leave out other pictures"
        )
    medians = np.stack([_medians(borders[:, :, side]) for side in (0, 1)], axis=1)
    lines = [_fit(borders[:, :, side], medians[:, side]) for side in (0, 1)]
    rows, columns = images.shape[1:3]
    view = LaneView(yellow=lines[0], white=lines[1], share=share, rows=rows, columns=columns, medians=medians)
    yellow, white = view.at(rows)
    if not (white - yellow > 0.1 * columns and view.yellow[0] < view.white[0] and view.horizon < 0.9 * rows):
        raise Sim2RealError(
            f"the {what} show nothing like a lane: its lines, {view.seen_through(Window(0, rows, 0, columns))}, do not "
            "meet ahead of the car: drive in the right lane, and leave out other pictures"
        )
    return view


def _medians(columns: NDArray[np.float64]) -> NDArray[np.float64]:
    """Median column in each row, from (images, rows); NaN in rows that seldom show the line."""
    counts = np.isfinite(columns).sum(axis=0)
    often = counts >= max(2, 0.4 * counts.max())
    return np.array([np.nanmedian(columns[:, row]) if is_often else np.nan for row, is_often in enumerate(often)])


def _fit(columns: NDArray[np.float64], row_medians: NDArray[np.float64]) -> tuple[float, float]:
    """Fit a straight line to the medians of (images, rows), once more without its worst fifth."""
    rows = np.flatnonzero(np.isfinite(row_medians))
    medians = row_medians[rows]
    weights = np.sqrt(np.isfinite(columns).sum(axis=0)[rows])
    for _ in range(2):
        slope, start = np.polyfit(rows, medians, 1, w=weights) if len(rows) > 1 else (0.0, float(medians[0]))
        errors = np.abs(slope * rows + start - medians)
        kept = errors <= np.quantile(errors, 0.8)
        rows, medians, weights = rows[kept], medians[kept], weights[kept]
    return float(slope), float(start)


@dataclass(frozen=True, slots=True, kw_only=True)
class Match:
    """Crops of simulated and real images that show the lane alike."""

    simulated: Window
    real: Window
    kept: float  # share of the simulator's view that is left
    difference: float  # of the measured lines, see `lane_difference`; compare it with `BOUND`


def match_windows(simulated: LaneView, window: Window, real: LaneView) -> Match:
    """Find the crops with which photographs show the lane as a simulator does in the window that a network sees.

    For each top and bottom row in the photographs, least squares over `HEIGHTS` give the left and right border. What
    lies outside the photographs is cut off in both domains. Of the crops that differ by at most half of `BOUND` the
    largest is used, or else the one that differs least; a Sim2RealError if there is none.
    """
    wanted = simulated.medians_in(window)
    matches: list[tuple[tuple[float, float, float], Match]] = []
    for top in range(round(HIGHEST_TOP * real.rows)):
        for bottom in range(top + round(LEAST_HEIGHT * real.rows), real.rows + 1):
            medians = real.medians[(top + HEIGHTS * (bottom - top)).astype(int).clip(0, real.rows - 1)]
            borders = _borders(wanted, medians)
            if borders is None:
                continue
            left, width = borders
            # What lies within the photographs, as shares of the width.
            u0, u1 = max(0.0, -left / width), min(1.0, (real.columns - left) / width)
            columns = (round(left + u0 * width), round(left + u1 * width))
            view = window.right - window.left
            inner = (round(window.left + u0 * view), round(window.left + u1 * view))
            try:
                windows = (Window(window.top, window.bottom, *inner), Window(top, bottom, *columns))
            except Sim2RealError:
                continue
            difference = lane_difference((simulated, real), windows)
            kept, area = max(0.0, u1 - u0), (bottom - top) * (columns[1] - columns[0])
            alike = difference <= BOUND / 2
            rank = (0.0, round(kept, 2), float(area)) if alike else (-difference, 0.0, 0.0)
            matches.append((rank, Match(simulated=windows[0], real=windows[1], kept=kept, difference=difference)))
    if not matches:
        raise Sim2RealError("no crop of the photographs shows the lane as the simulator does: mount the camera alike")
    return max(matches, key=itemgetter(0))[1]


def _borders(wanted: NDArray[np.float64], measured: NDArray[np.float64]) -> tuple[float, float] | None:
    """Left border and width, px, by least squares of found = left + width * wanted; None if too little is known."""
    both = np.isfinite(wanted) & np.isfinite(measured)
    if (both.sum(axis=0) < LEAST_HEIGHTS).any():
        return None
    x, y = wanted[both], measured[both]
    spread = x - x.mean()
    width = float(spread @ y / (spread @ spread))
    return (float(y.mean() - width * x.mean()), width) if width > 0.0 else None
