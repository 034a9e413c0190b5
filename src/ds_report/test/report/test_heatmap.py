# SPDX-License-Identifier: Apache-2.0
"""Pictures of feature maps: colours, hatching of empty cells, common bounds, reproducible bytes."""

from __future__ import annotations

from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_base.palette import FAIL, PASS, rgb
from ds_orchestrator.maps.feature_map import FeatureMap, MapCell, MapId, map_ids
from ds_report.heatmap import EMPTY, bounds_of, draw_map, write_maps
from ds_sim import SimulatorName

A, T = map(SimulatorName, "at")

BOUNDS = range(2, 5), range(17, 14, -1)


def make_map(map_id: MapId, cells: dict[tuple[int, int], tuple[float, float]]) -> FeatureMap:
    return FeatureMap(
        id=map_id,
        cells={
            cell: MapCell(tests=2, failures=None, probability=probability, quality_loss=quality)
            for cell, (probability, quality) in cells.items()
        },
    )


def pixels_of(image: NDArray[np.uint8], colour: tuple[int, int, int]) -> NDArray[np.intp]:
    """(n, 2) rows and columns."""
    return np.argwhere((image == colour).all(axis=2))


def test_a_cell_stands_where_its_features_say_and_an_empty_one_is_not_zero() -> None:
    picture = draw_map(make_map(MapId.merged(), {(2, 15): (1.0, 0.0)}), "probability", bounds=BOUNDS)
    red = pixels_of(picture, rgb(FAIL))
    grey = pixels_of(picture, EMPTY)
    assert len(red) > 500 and len(grey) > 8 * 500
    # Fewest turns: the left column. Smallest curvature: the lowest row. The colour bar is further right.
    in_grid = red[red[:, 1] < grey[:, 1].mean()]
    assert in_grid[:, 1].max() < np.percentile(grey[:, 1], 50) and in_grid[:, 0].min() > np.percentile(grey[:, 0], 50)
    zero = draw_map(make_map(MapId.merged(), {(2, 15): (0.0, 0.0)}), "probability", bounds=BOUNDS)
    assert len(pixels_of(zero, rgb(PASS))) > 500
    assert len(pixels_of(zero, EMPTY)) == len(grey)
    quality = draw_map(make_map(MapId.merged(), {(2, 15): (0.0, 1.0)}), "quality_loss", bounds=BOUNDS)
    assert len(pixels_of(quality, rgb(FAIL))) > 500


def test_excluded_tests_are_written_beside_and_in_cells_of_their_own() -> None:
    plain = make_map(MapId.union(A), {(3, 16): (0.0, 1.0)})
    apart = replace(plain, excluded={(3, 16): 2, (2, 17): 4, (4, 18): 1})
    bounds = bounds_of([apart])
    assert bounds == (range(2, 5), range(18, 15, -1))
    without, drawn = (draw_map(m, "probability", bounds=bounds) for m in (plain, apart))
    without = np.pad(without, ((0, 0), (0, drawn.shape[1] - without.shape[1]), (0, 0)), constant_values=255)
    changed = (without != drawn).any(axis=2)
    # Three cells, below the heading, which says what the numbers are; no colour of a probability changes.
    boxes = cv2.connectedComponents(cv2.dilate(changed[60:].astype(np.uint8), np.ones((9, 25))))[0] - 1
    assert boxes == 3 and changed[:60].any()
    assert pixels_of(drawn, rgb(PASS)).shape[0] > 0.9 * pixels_of(without, rgb(PASS)).shape[0]


def test_write_maps_writes_every_map_and_the_overview_with_equal_bytes(tmp_path: Path) -> None:
    ids = map_ids([A, SimulatorName("my:Sim")], T)
    names = [map_id.name for map_id in ids]
    maps = {map_id: make_map(map_id, {(3, 10 + k): (k / 9, 1 - k / 9)}) for k, map_id in enumerate(ids)}
    for folder in ("one", "two"):
        write_maps(maps, tmp_path / folder)
    written = {path.name: path.read_bytes() for path in (tmp_path / "one").iterdir()}
    files = [n if ":" not in n else f"{n.replace(':', '.')}-{sha256(n.encode()).hexdigest()[:8]}" for n in names]
    expected = {f"{n}_{v}.png" for n in files for v in ("probability", "quality")} | {"overview.png"}
    assert set(written) == expected
    assert written == {path.name: path.read_bytes() for path in (tmp_path / "two").iterdir()}
    single = cv2.imdecode(np.frombuffer(written["merged_quality.png"], np.uint8), cv2.IMREAD_COLOR)
    overview = cv2.imdecode(np.frombuffer(written["overview.png"], np.uint8), cv2.IMREAD_COLOR)
    assert single is not None and overview is not None
    # Two unions, the merge and the twin in two rows.
    assert overview.shape[0] == 2 * single.shape[0] and overview.shape[1] >= 4 * single.shape[1] - 100
    bounds = bounds_of(maps.values())
    drawn = cv2.cvtColor(draw_map(maps[MapId.merged()], "quality_loss", bounds=bounds), cv2.COLOR_RGB2BGR)
    np.testing.assert_array_equal(single, drawn)
