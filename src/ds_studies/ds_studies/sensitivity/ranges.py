# SPDX-License-Identifier: Apache-2.0
"""Ranges of conditions for a search, from the result of a sensitivity analysis."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ds_analysis.sensitivity.factors import COMPANIONS
from ds_base.bounded_json import read_json
from ds_sim.conditions.model import FIELDS, ConditionsError

MILDEST = {"visibility": 1000.0}
"""Mild end of a range, where the simulator's own world has none; chosen: the upper limit of fog (WMO-No. 8)."""
RESULT = "sensitivity.json"
"""Result of `ds sensitivity` in its folder."""


def read_ranges(folder: Path) -> dict[str, tuple[float, float]]:
    """Read `ranges_of` the result of `ds sensitivity --out`; `ConditionsError` if the folder holds none."""
    path = folder / RESULT
    try:
        return ranges_of(read_json(path))
    except (OSError, ValueError, KeyError, TypeError):
        raise ConditionsError(f"{path} is no result: expected a folder of `ds sensitivity --out`") from None


def ranges_of(document: dict[str, Any]) -> dict[str, tuple[float, float]]:
    """Range of every condition that makes a driver fail on at least half of the simulators, most sensitive first.

    The document is that of `Sensitivity`. A range reaches from the value that changes nothing to the strength at which
    the (lower) median simulator first fails, or to both hard ends; conditions that need others are left out.
    """
    rows: dict[tuple[str, float], list[dict[str, Any]]] = {}
    for row in document["thresholds"]:
        rows.setdefault((row["condition"], row["end"]), []).append(row)
    ranges: dict[str, tuple[float, float]] = {}
    for (name, _), of in rows.items():
        fails = sorted((row for row in of if row["verdict"] == "fails"), key=lambda row: row["share_of_range"])
        middle = (len(of) - 1) // 2
        if name not in FIELDS or name in COMPANIONS or middle >= len(fails):
            continue
        mild = MILDEST.get(name, fails[middle]["start"])
        ends = (mild, fails[middle]["first_fails"], *ranges.get(name, ()))
        ranges[name] = (float(min(ends)), float(max(ends)))
    return ranges
