# SPDX-License-Identifier: Apache-2.0
"""Feature maps of imported outcomes: each simulator's, the siblings' merged by every operator, and the twin's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ds_analysis.common.outcome_table import OutcomeTableError
from ds_analysis.outcomes.study import Study, axes_of
from ds_base.intervals import jeffreys_interval
from ds_orchestrator.maps.algebra import OPERATORS, merge
from ds_orchestrator.maps.feature_map import FeatureMap, MapCell, MapId
from ds_orchestrator.search.features import Cell


def maps_of_study(study: Study, features: list[str] | None = None) -> dict[MapId, FeatureMap]:
    """Build every map of a study, over its axes or over other features.

    A test that was repeated counts once, as in `Study.table`. A cell's quality loss is the mean of the margins as
    shares of their limits, at most 1, or of the failures where only verdicts are known.
    """
    if features is not None:
        unknown = [name for name in features if name not in study.features]
        if unknown:
            raise OutcomeTableError(f"no feature {unknown[0]!r:.60}, expected one of {', '.join(study.features)}")
        study = replace(study, axes=axes_of(study.rows, features))
    table = study.table()
    shares = np.minimum(table.lateral / table.limits, 1.0)

    def on(map_id: MapId) -> FeatureMap:
        of_cell: dict[Cell, list[int]] = {}
        for row in np.flatnonzero(table.known(map_id.simulator)).tolist():
            of_cell.setdefault(table.cells[row] or (), []).append(row)
        failed, share = table.failed(map_id.simulator), shares[:, table.column(map_id.simulator)]
        losses = np.where(np.isnan(share), failed, share)
        cells = {}
        for cell, rows in sorted(of_cell.items()):
            tests, failures = len(rows), int(failed[rows].sum())
            cells[cell] = MapCell(
                tests=tests,
                failures=failures,
                probability=failures / tests,
                quality_loss=float(losses[rows].mean()),
                interval=jeffreys_interval(failures, tests),
            )
        return FeatureMap(id=map_id, cells=cells, features=table.axes)

    maps = {map_id: on(map_id) for map_id in map(MapId.union, table.siblings)}
    unions = list(maps.values())
    maps |= {
        map_id: merge(map_id, unions, probability=map_id.operator or "product")
        for map_id in (MapId.merged(), *map(MapId.merged, OPERATORS))
    }
    return maps if study.twin is None else {**maps, MapId.twin(study.twin): on(MapId.twin(study.twin))}
