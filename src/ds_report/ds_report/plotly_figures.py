# SPDX-License-Identifier: Apache-2.0
"""Plotly layouts that the report's script fills, and charts of the comparison with the twin."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import plotly.graph_objects as go

from ds_analysis.paper.correlation import Correlation
from ds_analysis.paper.paper_tables import Network, paper_row, role_of
from ds_base.palette import BETWEEN, FAIL, PASS, SERIES
from ds_base.table import Table
from ds_sim.registry import SimulatorName

INK, SOFT, LINE = "#1e2329", "#58606b", "#d9dde3"
CAMPAIGN, PAPER = SERIES[0], SERIES[3]
SCALES: Mapping[str, Sequence[tuple[float, str]]] = {
    "probability": ((0, PASS), (0.5, BETWEEN), (1, FAIL)),
    # ColorBrewer's PuBu and Greys: lightness falls monotonically, which suits every kind of colour vision and print.
    "quality_loss": ((0, "#f3eef7"), (0.25, "#bfcbe3"), (0.5, "#74a9cf"), (0.75, "#0570b0"), (1, "#02304f")),
    "tests": ((0, "#f2f2f2"), (0.25, "#cfd3d6"), (0.5, "#9aa1a7"), (0.75, "#63696f"), (1, "#25282b")),
}
"""Value -> colour scale, from the smallest value to the largest."""
DASHES = ("solid", "dash", "dot", "dashdot", "longdash")
"""Dashes of the simulators' lines, in Plotly's names: colour alone is not accessible."""
_FONT = {"family": 'system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif', "size": 12, "color": INK}
_ROW, _LEAST, _MOST = 17, 230, 560
"""Height of a map's row, and smallest and largest height of a map, pixels."""


def layouts(rows: int) -> dict[str, Any]:
    """Create layouts by name: `map`, `road`, `lateral` and `steering`; the script sets axes of maps with such rows."""
    # Automatic margins together with a scale anchor would never converge.
    grid = {"showgrid": True, "gridcolor": "#e3e7dc", "automargin": False}
    plots = {
        "map": _layout(
            margin={"l": 46, "r": 6, "t": 6, "b": 44},
            height=min(max(_ROW * rows, _LEAST), _MOST) + 46,
            xaxis=_axis(ticks="", side="bottom"),
            yaxis=_axis(ticks=""),
        ),
        "road": _layout(
            margin={"l": 44, "r": 8, "t": 8, "b": 40},
            height=430,
            plot_bgcolor="#f0f4ea",
            hovermode="closest",
            xaxis=_axis("x, m", **grid),
            yaxis=_axis("y, m", scaleanchor="x", scaleratio=1, **grid),
        ),
        "lateral": _line_layout("lateral position, m", autorange="reversed"),
        "steering": _line_layout("steering, 1 = full lock", range=[1.08, -1.08], tickvals=[-1, 0, 1]),
    }
    scales = {name: [list(stop) for stop in scale] for name, scale in SCALES.items()}
    return {**{name: layout.to_plotly_json() for name, layout in plots.items()}, "scales": scales}


def _layout(**more: Any) -> go.Layout:
    """Build the common layout of all charts: no zooming or dragging, so that the page can be scrolled."""
    common: dict[str, Any] = {
        "template": None,
        "font": _FONT,
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "showlegend": False,
        "dragmode": False,
        "hoverlabel": {"bgcolor": "#ffffff", "bordercolor": SOFT, "font": {**_FONT, "size": 12}, "align": "left"},
    }
    return go.Layout(**{**common, **more})


def _axis(title: str = "", **more: Any) -> dict[str, Any]:
    options = {
        "title": {"text": title, "font": {"size": 12, "color": SOFT}, "standoff": 6},
        "tickfont": {"size": 11, "color": SOFT},
        "fixedrange": True,
        "zeroline": False,
        "showgrid": False,
        "linecolor": LINE,
        "automargin": True,
    }
    return {**options, **more}


def _line_layout(title: str, **more: Any) -> go.Layout:
    grid = {"showgrid": True, "gridcolor": "#e8ebef"}
    return _layout(
        margin={"l": 54, "r": 8, "t": 8, "b": 36},
        height=205,
        hovermode="x unified",
        xaxis=_axis("distance driven, m", rangemode="tozero", unifiedhovertitle={"text": "%{x:.0f} m driven"}, **grid),
        yaxis=_axis(title, **grid, **more),
    )


def correlation_chart(
    correlations: Sequence[Correlation], siblings: Sequence[SimulatorName], network: Network | None
) -> dict[str, Any] | None:
    """Chart the campaign's correlations with intervals, and the paper's: r left, AUC-PRC right; None without any."""
    if not any(c.r is not None or c.auc is not None for c in correlations):
        return None
    labels = []
    for c in correlations:
        question, simulator = "RQ2" if c.value == "probability" else "RQ3", c.map.simulator
        labels.append(f"{question} {role_of(simulator, siblings)} {simulator or 'merged'}")
    tentative = any(c.caution for c in correlations)
    figure = go.Figure(layout=_correlation_layout(labels, correlations))
    for axis, value, ends in (("x", "r", "r_interval"), ("x2", "auc", "auc_interval")):
        measured = [(label, c) for label, c in zip(labels, correlations, strict=True) if getattr(c, value) is not None]
        middles = [getattr(c, value) for _, c in measured]
        intervals = [getattr(c, ends) or (m, m) for (_, c), m in zip(measured, middles, strict=True)]
        some = any(getattr(c, ends) for _, c in measured)
        figure.add_scatter(
            x=middles,
            y=[label for label, _ in measured],
            xaxis=axis,
            error_x={
                "visible": some,
                "type": "data",
                "array": [high - m for (_, high), m in zip(intervals, middles, strict=True)],
                "arrayminus": [m - low for (low, _), m in zip(intervals, middles, strict=True)],
                "color": CAMPAIGN,
                "thickness": 2,
                "width": 5,
            },
            mode="markers",
            marker={"color": CAMPAIGN, "size": 10, **({"symbol": "circle-open"} if tentative else {})},
            name="this campaign, too few cells for a conclusion" if tentative else "this campaign, with 95% interval",
            showlegend=axis == "x",
            hovertemplate="%{y}: %{x:.3f}<extra>this campaign</extra>",
        )
        of_paper = [paper_row(c.value, network, role_of(c.map.simulator, siblings)) for c in correlations]
        shown = [(label, getattr(row, value)) for label, row in zip(labels, of_paper, strict=True) if row]
        if shown:
            figure.add_scatter(
                x=[number for _, number in shown],
                y=[label for label, _ in shown],
                xaxis=axis,
                mode="markers",
                marker={"color": PAPER, "size": 11, "symbol": "diamond-open", "line": {"width": 2}},
                name="the paper",
                showlegend=axis == "x",
                hovertemplate="%{y}: %{x:.3f}<extra>the paper</extra>",
            )
    return dict(figure.to_plotly_json())


def _correlation_layout(labels: Sequence[str], correlations: Sequence[Correlation]) -> go.Layout:
    lows = [c.r_interval[0] for c in correlations if c.r_interval] + [c.r for c in correlations if c.r is not None]
    grid = {"showgrid": True, "gridcolor": "#e8ebef", "zeroline": True, "zerolinecolor": "#9aa1a7"}
    shares = sorted({c.baseline for c in correlations if c.baseline is not None})
    dots = {"color": SOFT, "dash": "dot", "width": 1.5}
    upright = {"type": "line", "y0": 0, "y1": 1, "xref": "x2", "yref": "paper", "line": dots}
    chance = [{**upright, "x0": share, "x1": share} for share in shares]
    return _layout(
        margin={"l": 8, "r": 12, "t": 36, "b": 40},
        height=90 + 34 * len(labels),
        showlegend=True,
        legend={"orientation": "h", "x": 0, "y": 1.02, "yanchor": "bottom"},
        hovermode="closest",
        xaxis=_axis("Pearson's r", domain=[0, 0.48], range=[min([0.0, *lows]) - 0.05, 1.05], **grid),
        xaxis2=_axis("AUC-PRC (dotted: chance)", domain=[0.52, 1], range=[-0.02, 1.05], anchor="y", **grid),
        yaxis=_axis(categoryorder="array", categoryarray=list(labels)[::-1], showgrid=True, gridcolor="#f0f2f4"),
        shapes=chance,
    )


def density_chart(table: Table) -> dict[str, Any]:
    """Chart RQ1's densities of steering errors as lines; the table is `rq1_densities`."""
    figure = go.Figure(
        layout=_layout(
            margin={"l": 54, "r": 12, "t": 36, "b": 40},
            height=320,
            showlegend=True,
            legend={"orientation": "h", "x": 0, "y": 1.02, "yanchor": "bottom"},
            hovermode="x unified",
            xaxis=_axis("absolute steering error, share of full lock", showgrid=True, gridcolor="#e8ebef"),
            yaxis=_axis("density", rangemode="tozero", showgrid=True, gridcolor="#e8ebef"),
        )
    )
    middles = [(float(row[0]) + float(row[1])) / 2 for row in table.rows]  # type: ignore[arg-type]
    for k, column in enumerate(table.columns[2:]):
        figure.add_scatter(
            x=middles,
            y=[row[2 + k] for row in table.rows],
            mode="lines+markers",
            line={"shape": "hvh", "width": 2, "dash": DASHES[k % len(DASHES)], "color": SERIES[k % len(SERIES)]},
            name=column.name,
            hovertemplate="%{y:.2f}",
        )
    return dict(figure.to_plotly_json())
