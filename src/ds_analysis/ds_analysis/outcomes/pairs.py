# SPDX-License-Identifier: Apache-2.0
"""Compares two drivers by two studies of the same tests, on somebody's simulators."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ds_analysis.common.outcome_table import OutcomeTable, OutcomeTableError, State
from ds_analysis.common.statistics import are_alone
from ds_analysis.comparison.analysis import Comparison, compare_networks
from ds_analysis.comparison.paired_drives import ComparedTest, DriveOutcome, Network, PairedDrive
from ds_analysis.outcomes.study import read_study
from ds_driver.networks.driver_name import DriverName
from ds_sim.registry import SimulatorName
from ds_sim.simulator import Outcome

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
