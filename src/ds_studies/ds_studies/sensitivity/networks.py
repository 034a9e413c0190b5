# SPDX-License-Identifier: Apache-2.0
"""Sensitivity of several networks to the same conditions: one row for each network."""

from __future__ import annotations

from collections.abc import Sequence

from ds_analysis.common.table import Column, Table, Value
from ds_studies.sensitivity.analysis import Sensitivity


def networks_table(found: Sequence[Sensitivity]) -> Table:
    """Tabulate which share of each condition's range every network withstands, on the simulator where that is least.

    Args:
        found: one analysis for each network, all of the same factors and simulators.
    """
    factors = found[0].factors
    rows: list[list[Value]] = []
    for one in found:
        least: list[float | None] = []
        for position in range(len(factors)):
            withstood = [one.thresholds[position, name].withstood for name in one.simulators]
            least.append(min((share for share in withstood if share is not None), default=None))
        known = [share for share in least if share is not None]
        weakest = factors[one.order[0]].title if known and min(known) < 1.0 else "none"
        completed = sum(map(len, one.roads.values()))
        rows.append([one.driver, completed, sum(known) / len(known) if known else None, weakest, *least])
    return Table(
        name="networks",
        title="Share of each condition's range that a network withstands",
        columns=[
            Column("network"), Column("roads", "count"), Column("mean", "number"), Column("weakest to"),
            *(Column(factor.title, "number") for factor in factors),
        ],
        rows=rows,
        notes=[
            "On the simulator where that is least; 1: no failure up to the hardest value. Roads: completed without any "
            f"condition, of {found[0].needed * len(found[0].simulators)}; each network is tested on its own. "
            "Weakest to: the smallest of these shares, on these roads."
        ],
    )  # fmt: skip
