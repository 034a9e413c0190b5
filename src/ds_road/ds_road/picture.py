# SPDX-License-Identifier: Apache-2.0
"""Draws a road seen from above, as in figure 2 of the paper."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from ds_base.figures import draw_figure
from ds_base.palette import ASPHALT, CENTRE_LINE, EDGE_LINE, GRASS, SERIES
from ds_road.road import Road, RoadError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SMALLEST, LARGEST = 320, 4000
"""Limits of the longer side, pixels; chosen: the caption fits, and drawing takes a few hundred megabytes at most."""
_MARGIN, _TRAJECTORY_MARGIN = 10.0, 30.0
_CAPTION, _ROW, _STRIP = 76, 20, 30

Array = NDArray[np.float64]
Name = TypeVar("Name", bound=str)


def draw(
    road: Road,
    *,
    trajectories: Mapping[Name, Array] | None = None,
    colours: Mapping[Name, str] | None = None,
    size: int = 640,
    caption: bool = True,
) -> NDArray[np.uint8]:
    """Draw a road: white edges, yellow centre line, start as triangle, end as square.

    Control points are red stars; with trajectories, whose ends are marked by discs, they are left out.

    Args:
        road: road to draw, valid or not.
        trajectories: name -> (n, 2) positions, m, drawn over the road with a legend. A trajectory that strays more
            than 30 m from the area of the road is cut off at the border of the picture.
        colours: name -> colour of a trajectory; those of `ds_base.palette.SERIES` in order if None.
        size: longer side of the picture without its caption, pixels, 320 to 4000.
        caption: whether to write id, length and features below the picture.

    Returns:
        (rows, columns, 3) uint8 RGB.

    Raises:
        RoadError: the size is out of range, or a trajectory is not an array of finite positions.

    Examples:
        >>> from ds_road import Road, draw
        >>> draw(Road([(125, 0), (125, 25), (125, 50), (140, 75)])).shape
        (716, 400, 3)
    """
    if not SMALLEST <= size <= LARGEST:
        raise RoadError(f"picture size is {size}, expected {SMALLEST} to {LARGEST} pixels")
    paths = {name: _path(name, path) for name, path in (trajectories or {}).items()}
    low, high = _extent(road, paths)
    width, height = high - low
    scale = min(size / width, (size - _STRIP) / height)
    columns, rows = (max(round(side), size * 5 // 8) for side in (width * scale, height * scale + _STRIP))
    corner = (low + high - np.array((columns, rows + _STRIP)) / scale) / 2  # a strip for the scale bar below the road
    footer = _CAPTION if caption else 0

    def paint(figure: Figure) -> None:
        axes = map_axes(figure, road, corner, scale, (columns, rows), footer)
        for index, (name, path) in enumerate(paths.items()):
            colour = (colours or {}).get(name) or SERIES[index % len(SERIES)]
            end = [-1] if len(path) else []
            axes.plot(*path.T, color=EDGE_LINE, linewidth=3.5, alpha=0.7, zorder=4)  # dark colours on asphalt
            (line,) = axes.plot(*path.T, color=colour, linewidth=1.7, label=name, zorder=4)
            line.set(marker="o", markevery=end, markersize=7, markeredgecolor=EDGE_LINE)
        if paths:
            axes.legend(loc="upper left", fontsize=10)
        elif not road.sampled:
            axes.plot(*np.transpose(road.control_points), "*", color="#d72828", markersize=13, markeredgecolor="black")
        for marker, at, step in (
            ((3, 0), road.lane_centre[0], np.diff(road.lane_centre[:2], axis=0)[0]),
            ((4, 0), road.lane_centre[-1], np.diff(road.lane_centre[-2:], axis=0)[0]),
        ):
            turned = float(np.degrees(np.arctan2(step[1], step[0]))) - 90.0 + 45.0 * (marker[0] == 4)
            axes.plot(*at, marker=(*marker, turned), color="black", markersize=13, zorder=3)
        _scale_bar(axes, columns, footer, scale)
        if caption:
            _write_caption(figure, road, columns)

    return draw_figure(columns, rows + footer, paint)


def map_axes(figure: Figure, road: Road, corner: Array, scale: float, size: tuple[int, int], footer: int = 0) -> Axes:
    """Draw a road on grass in an empty figure, `scale` pixels per metre.

    The lower left corner is in the road frame, m; the map's size is columns and rows, the footer rows below it, px.
    """
    columns, rows = size
    figure.set_layout_engine("none")
    axes = figure.add_axes((0.0, footer / (rows + footer), 1.0, rows / (rows + footer)), facecolor=GRASS)
    axes.set(xlim=(corner[0], corner[0] + columns / scale), ylim=(corner[1], corner[1] + rows / scale))
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
    axes.fill(*np.vstack((road.left_edge, road.right_edge[::-1])).T, color=ASPHALT, linewidth=0)
    lines = ((road.left_edge, EDGE_LINE), (road.right_edge, EDGE_LINE), (road.points, CENTRE_LINE))
    for line, colour in lines if road.has_centre_line else lines[:2]:
        axes.plot(*line.T, color=colour, linewidth=1.5, scalex=False, scaley=False)
    axes.set_autoscale_on(False)
    return axes


def _path(name: str, path: Array) -> Array:
    positions = np.asarray(path, dtype=np.float64)
    if positions.ndim != 2 or positions.shape[1] < 2 or not np.isfinite(positions[:, :2]).all():
        raise RoadError(f"trajectory {name}: array of shape {positions.shape}, expected (n, 2) finite metres")
    return positions[:, :2]


def _extent(road: Road, paths: Mapping[Name, Array]) -> tuple[Array, Array]:
    """Corners of the whole road, and of the trajectories where they stay near it, with a margin, m."""
    surface = np.vstack((road.left_edge, road.right_edge, np.array(road.control_points)))
    low, high = surface.min(axis=0) - _TRAJECTORY_MARGIN, surface.max(axis=0) + _TRAJECTORY_MARGIN
    near = np.vstack((surface, *(np.clip(path, low, high) for path in paths.values())))
    return near.min(axis=0) - _MARGIN, near.max(axis=0) + _MARGIN


def _scale_bar(axes: Axes, columns: int, footer: int, scale: float) -> None:
    """Draw a scale bar at the lower right: a round number of metres, at most a fifth of the picture wide."""
    power = 10.0 ** np.floor(np.log10(columns / 5 / scale))
    metres = max(factor * power for factor in (1, 2, 5) if factor * power * scale <= columns / 5)
    right, row = columns - 14, footer + 12
    axes.annotate(
        "",
        (right - metres * scale, row),
        (right, row),
        xycoords="figure pixels",
        arrowprops={"arrowstyle": "|-|,widthA=0.3,widthB=0.3", "shrinkA": 0, "shrinkB": 0},
    )
    axes.annotate(f"{metres:g} m", (right, row + 6), xycoords="figure pixels", ha="right", fontsize=10)


def _write_caption(figure: Figure, road: Road, columns: int) -> None:
    """Write id, features and validity below the picture, smaller where the picture is narrow."""
    text = [
        f"{road.road_id}   {road.length:.0f} m{'' if road.lane == 'right' else f'   {road.lane} lane'}",
        f"turns {road.turns_count}   curvature {road.curvature:.3f} /m",
        "valid" if road.validity.valid else f"not valid: {road.validity.reason}",
    ]
    for index, line in enumerate(text):
        size = min(10.0, (columns - 16) / (0.85 * max(len(line), 1)))
        figure.text(10, _CAPTION - 22 - _ROW * index, line, transform=None, fontsize=size)
