# SPDX-License-Identifier: Apache-2.0
"""Populations of simulators with known boundaries, simulated by hand, and drives on a car."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ds_analysis.common.outcome_table import RoadTable, State
from ds_analysis.real.records import RealDrive
from ds_road import Road, generate
from ds_sim import SimulatorName

Array = NDArray[np.float64]
ROAD: Road = generate(np.random.default_rng(3), max_angle=200)


def made_up(seed: int, *, tests: int, siblings: int = 3, car: Array | None = None) -> RoadTable:
    """Draw simulators, tests and outcomes; the last simulator plays the twin, with given coefficients if any."""
    rng = np.random.default_rng(seed)
    features = rng.normal(size=(tests, 4))
    coefficients = np.array([-0.5, 0.3, 0.2, -0.2, 0.1])
    coefficients = coefficients + [0.3, 0.12, 0.12, 0.12, 0.12] * rng.normal(size=(siblings + 1, 5))
    if car is not None:
        coefficients[-1] = car
    shared, own = 0.3 * rng.normal(size=(tests, 1)), 0.25 * rng.normal(size=(tests, siblings + 1))
    margins = np.column_stack((np.ones(tests), features)) @ coefficients.T + shared + own
    return table_of_margins(margins, features)


def table_of_margins(margins: Array, features: Array, *, family: int = 5, names: str = "a") -> RoadTable:
    """Make a table whose tests fail where their margin is positive; cells are quarters of the first two features."""
    tests, simulators = margins.shape
    bins = np.digitize(features[:, : min(2, features.shape[1])], (-1.0, 0.0, 1.0))
    bins = np.column_stack((bins, np.zeros((tests, 2 - bins.shape[1]), int)))
    states = np.where(margins > 0, State.FAILED, State.COMPLETED).astype(np.int8)
    table = RoadTable.of(
        (ROAD,) * tests,
        states,
        2.0 * np.exp(margins),
        test_ids=tuple(f"{names}-0-{k:04d}" for k in range(tests)),
        siblings=tuple(map(SimulatorName, "abcdefg"[: simulators - 1])),
        twin=SimulatorName("twin"),
        cells=tuple((int(a), int(b)) for a, b in bins),
    )
    columns = tuple(f"feature_{k}" for k in range(features.shape[1]))
    return replace(table, feature_names=columns, features=features, families=np.arange(tests) // family)


def real_drive(test_id: str, failed: bool, *, drawn: bool = False) -> RealDrive:
    return RealDrive(
        test_id=test_id,
        failed=failed,
        outcome="failed" if failed else "completed",
        max_lateral_position=None,
        who="Ada",
        when="2026-03-01",
        source="here",
        drawn=drawn,
    )
