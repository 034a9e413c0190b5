# SPDX-License-Identifier: Apache-2.0
"""Feature maps of imported outcomes: each simulator's, the siblings' merged by every operator, and the twin's."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ds_analysis.common.outcome_table import OutcomeTableError
from ds_analysis.outcomes.study import Study, axes_of
from ds_base.intervals import jeffreys_interval
from ds_orchestrator.maps.algebra import OPERATORS, merge
from ds_orchestrator.maps.feature_map import FeatureMap, MapCell, MapId
from ds_orchestrator.search.features import Cell, column_axis


def maps_of_study(study: Study, features: list[str] | None = None) -> dict[MapId, FeatureMap]:
    """Build every map of a study.

    A cell's quality loss is the mean of the margins as shares of their limits, at most 1, or its failure rate where
    only verdicts are known.

    Args:
        study: outcomes.
        features: axes other than the study's.

    Raises:
        OutcomeTableError: a feature is unknown.
    """
    if features is not None:
        unknown = [name for name in features if name not in study.features]
        if unknown:
            raise OutcomeTableError(f"no feature {unknown[0]!r:.60}, expected one of {', '.join(study.features)}")
        study = replace(study, axes=axes_of(study.rows, features))
    axes = tuple(column_axis(name, width) for name, width in study.axes.items())
    rows = study.rows.assign(
        loss=np.minimum(study.rows["margin"] / study.rows["limit"], 1.0).fillna(study.rows["failed"].astype(float)),
        **{f"bin {k}": np.floor(study.rows[name] / width) for k, (name, width) in enumerate(study.axes.items())},
    )

    def on(map_id: MapId) -> FeatureMap:
        cells: dict[Cell, MapCell] = {}
        own: Any = rows[rows["simulator"] == map_id.simulator].groupby([f"bin {k}" for k in range(len(axes))])
        for cell, group in own:
            tests, failures = len(group), int(group["failed"].sum())
            cells[tuple(map(int, cell))] = MapCell(
                tests=tests,
                failures=failures,
                probability=failures / tests,
                quality_loss=float(group["loss"].mean()),
                interval=jeffreys_interval(failures, tests),
            )
        return FeatureMap(id=map_id, cells=cells, features=axes)

    siblings = [name for name in study.simulators if name != study.twin]
    maps = {map_id: on(map_id) for map_id in map(MapId.union, siblings)}
    unions = list(maps.values())
    maps |= {
        map_id: merge(map_id, unions, probability=map_id.operator or "product")
        for map_id in (MapId.merged(), *map(MapId.merged, OPERATORS))
    }
    return maps if study.twin is None else {**maps, MapId.twin(study.twin): on(MapId.twin(study.twin))}
