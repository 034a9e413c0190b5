# SPDX-License-Identifier: Apache-2.0
"""What `ds outcomes` and `ds maps` print of tables of others."""

from __future__ import annotations

import io
import re

import pytest
from rich.console import Console

from ds_cli.maps import grids
from ds_orchestrator.maps.feature_map import FeatureMap, MapCell, MapId
from ds_orchestrator.search.features import column_axis


@pytest.mark.parametrize("width", [40, 80, 100, 133])
def test_a_grid_as_wide_as_the_terminal_shows_every_cell(width: int) -> None:
    cells = {
        (k, 3): MapCell(tests=1000 + k, failures=100 * k, probability=k / 20, quality_loss=0.0) for k in range(3, 20)
    }
    axes = (column_axis("speed", 1.0), column_axis("curvature", 0.02))
    made = FeatureMap(id=MapId.union("a"), cells=cells, features=axes, excluded={(7, 3): 12})
    console = Console(width=width, file=io.StringIO())
    for grid in grids(made, "probability", width):
        console.print(grid)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert re.findall(r"\d+/\d+", text) == [f"{100 * k}/{1000 + k}" for k in range(3, 20)]
    assert "-12" in text and "0.06" in text and "…" not in text
