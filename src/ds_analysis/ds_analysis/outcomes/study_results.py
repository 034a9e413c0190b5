# SPDX-License-Identifier: Apache-2.0
"""What studies show: the feature maps of one, and a comparison of the drivers of two."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from ds_analysis.common.outcome_table import OutcomeTable, OutcomeTableError, State
from ds_analysis.common.statistics import are_alone
from ds_analysis.comparison.analysis import Comparison, compare_networks
from ds_analysis.comparison.paired_drives import ComparedTest, DriveOutcome, Network, PairedDrive
from ds_analysis.outcomes.study import Study, axes_of, read_study
from ds_base.intervals import jeffreys_interval
from ds_driver.networks.driver_name import DriverName
from ds_orchestrator.maps.algebra import OPERATORS, merge
from ds_orchestrator.maps.feature_map import FeatureMap, MapCell, MapId
from ds_orchestrator.search.features import Cell
from ds_sim.registry import SimulatorName
from ds_sim.simulator import Outcome


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


_OUTCOMES: Mapping[int, Outcome] = {State.COMPLETED: Outcome.COMPLETED, State.FAILED: Outcome.OUT_OF_BOUNDS}


def compare_studies(reference: Path, candidate: Path) -> Comparison:
    """Compare two studies' drivers on the tests and simulators that both have; a test that was repeated counts once."""
    first, second = (read_study(folder).table() for folder in (reference, candidate))
    names = [name for name in first.simulators if name in second.simulators]
    pairs = []
    for row, test in enumerate(first.test_ids):
        compared = ComparedTest(name=test, scenario=None, cell=first.cells[row])
        for name in names:
            one = _outcome(first, row, name)
            other = _outcome(second, second.rows[test], name) if test in second.rows else None
            if one is not None and other is not None:
                pairs.append(PairedDrive(test=compared, simulator=name, reference=one, candidate=other))
    if not pairs:
        raise OutcomeTableError(f"{reference} and {candidate} share no test on a simulator: expected the same test_id")
    return compare_networks(
        pairs,
        reference=Network(driver=DriverName(reference.resolve().name)),
        candidate=Network(driver=DriverName(candidate.resolve().name)),
        origin="random" if are_alone(first.families) else "both",
        source=f"{len({pair.test.name for pair in pairs})} tests that the studies {reference} and {candidate} share",
        simulators=names,
        features=first.axes,
        twin=first.twin if first.twin in names else None,
    )


def _outcome(table: OutcomeTable, row: int, name: SimulatorName) -> DriveOutcome | None:
    column = table.column(name)
    outcome = _OUTCOMES.get(int(table.states[row, column]))
    if outcome is None:
        return None
    margin = float(table.limits[row, column] - table.lateral[row, column])
    return DriveOutcome(outcome=outcome, fitness=margin if np.isfinite(margin) else None)
