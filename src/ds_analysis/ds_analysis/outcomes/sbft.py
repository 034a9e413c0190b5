# SPDX-License-Identifier: Apache-2.0
"""Reads the test files of SBFT's tool competition for cyber-physical systems, one folder for each simulator.

A file is one executed road: `road_points` or `interpolated_points` [[x, y], ...] in metres, `test_outcome` PASS, FAIL
or ERROR, `is_valid` (github.com/sbft-cps-tool-competition/cps-tool-competition, `code_pipeline/tests_generation.py`).
Equal road points are the same test, whatever the folder; ERROR and invalid roads are no outcomes.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ds_analysis.common.outcome_table import OutcomeTableError
from ds_base.bounded_file import read_json
from ds_base.left_out import LeftOut
from ds_road.geometry import arc_lengths

LARGEST_FILE, MOST_FILES = 2**26, 100_000
STEP = 2.0
"""Distance of the points between which a road's features are taken, m; chosen: a curve of BeamNG's maps is longer."""


def read_competition(folders: Sequence[Path], left_out: LeftOut | None = None) -> pd.DataFrame:
    """Read folders, one for each simulator, as one table: test_id, simulator, repeat, failed, and the road's features.

    `left_out` takes files that cannot be read; None refuses them.
    """
    rows: list[dict[str, Any]] = []
    left_out = left_out or LeftOut("rows", strict=True)
    for folder in folders:
        paths = sorted(folder.rglob("*.json"))[: MOST_FILES + 1]
        if not 0 < len(paths) <= MOST_FILES:
            raise OutcomeTableError(f"{folder} has {len(paths)} JSON files, expected 1 to {MOST_FILES} of tests")
        counts: dict[str, int] = {}
        for path in paths:
            try:
                row = _row(path)
            except OutcomeTableError as error:
                left_out.total += 1
                left_out.add(str(path), error)
                continue
            if row is not None:
                counts[row["test_id"]] = counts.get(row["test_id"], -1) + 1
                rows.append({**row, "simulator": folder.resolve().name, "repeat": counts[row["test_id"]]})
    if not rows:
        reason = f": {left_out.items[0][1]}" if left_out.items else ""
        raise OutcomeTableError(f"{folders[0]}: no file has a test_outcome PASS or FAIL of a valid road{reason}")
    return pd.DataFrame(rows)


def _row(path: Path) -> dict[str, Any] | None:
    """The test of a file; None if it has no verdict."""
    bad = f"{path} is no test file of SBFT's competition"
    try:
        document = read_json(path, LARGEST_FILE)
        outcome = str(document["test_outcome"]).upper()
        if outcome not in ("PASS", "FAIL") or document.get("is_valid", True) is False:
            return None
        road_points = np.array([[float(value) for value in point[:2]] for point in document["road_points"]])
        points = np.array([point[:2] for point in document.get("interpolated_points") or road_points], np.float64)
    except (OSError, ValueError, KeyError, TypeError, IndexError, AttributeError, OverflowError):
        raise OutcomeTableError(f"{bad}: expected test_outcome and road_points") from None
    if len(points) < 3 or points.shape[1:] != (2,) or not np.isfinite([*road_points, *points]).all():
        raise OutcomeTableError(f"{bad}: expected three or more finite road_points")
    name = hashlib.sha256(np.round(road_points, 3).tobytes()).hexdigest()[:12]
    return {"test_id": name, "failed": outcome == "FAIL", **_features(points, bad)}


def _features(points: np.ndarray, bad: str) -> dict[str, float]:
    along = arc_lengths(points)
    if not 2.0 * STEP < along[-1] < 1e5:
        raise OutcomeTableError(f"{bad}: its road is {along[-1]:.3g} m long, expected {2.0 * STEP:g} m to 100 km")
    even = np.linspace(0.0, along[-1], max(4, int(along[-1] / STEP) + 1))
    x, y = (np.interp(even, along, column) for column in points.T)
    turn = np.diff(np.unwrap(np.arctan2(np.diff(y), np.diff(x))))
    return {
        "total_turn": float(np.degrees(np.abs(turn).sum())),
        "largest_curvature": float(np.abs(turn).max() / (even[1] - even[0])),
        "length": float(along[-1]),
    }
