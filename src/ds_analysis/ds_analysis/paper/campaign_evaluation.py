"""Evaluates a campaign: maps, comparison with the twin, tables, and tests by which no network can be judged."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from ds_analysis.common.statistics import RESAMPLES
from ds_analysis.common.table import Column, Table
from ds_analysis.paper.correlation import Correlation, PairedDifference, check_robustness, evaluate, paired_differences
from ds_analysis.paper.open_loop import architecture_of, kind_of
from ds_analysis.paper.paper_tables import (
    NETWORKS,
    Network,
    cautions,
    correlation_tables,
    paired_difference_table,
    robustness_table,
)
from ds_driver.whole_files import write_json
from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.folder import CampaignData
from ds_orchestrator.maps.campaign_maps import build_maps
from ds_orchestrator.maps.feature_map import FeatureMap, MapId, map_ids
from ds_orchestrator.store.folder_files import read_file
from ds_orchestrator.store.sqlite_file import StoreError
from ds_sim.conditions.text import format_conditions
from ds_sim.gates.gate import GateState

CORRELATIONS = Path("maps/correlations.json")
"""File with the comparison with the twin, relative to the campaign folder."""
_RENAMED_VALUES = {"quality": "quality_loss"}
"""Value in files of earlier versions -> present name."""


def maps_of(data: CampaignData, *, features: Sequence[str] | None = None) -> dict[MapId, FeatureMap]:
    """Build every map of a campaign, finished or not.

    Args:
        data: contents of the campaign's store.
        features: names of the axes; the configured ones if None.
    """
    config = data.config
    plan = config.map_plan(data.given_up)
    if features is not None:
        plan = replace(plan, features=tuple(features))
    return build_maps(config.siblings, config.twin, data.tests, data.executions, plan, gates=data.gates)


def correlations_of(config: CampaignConfig, maps: Mapping[MapId, FeatureMap]) -> list[Correlation]:
    """Compare the siblings' maps with the twin's; empty without a twin."""
    return evaluate(maps, config.siblings, config.twin, resamples=RESAMPLES) if config.twin else []


def paired_differences_of(config: CampaignConfig, maps: Mapping[MapId, FeatureMap]) -> list[PairedDifference]:
    """Compute the paired differences between the merged map and each sibling's; empty without a twin."""
    return paired_differences(maps, config.siblings, config.twin) if config.twin else []


def write_correlations(folder: Path, correlations: Sequence[Correlation]) -> None:
    """Write `maps/correlations.json` of a campaign folder."""
    rows = [correlation.document() for correlation in correlations]
    write_json(folder / CORRELATIONS, rows)


def read_correlations(folder: Path, config: CampaignConfig) -> list[Correlation]:
    """Read correlations that this version or an earlier one wrote.

    Raises:
        StoreError: the file is damaged.
    """
    by_name = {map_id.name: map_id for map_id in map_ids(config.siblings, config.twin)}
    known = {field.name for field in fields(Correlation)}
    try:
        rows: list[dict[str, Any]] = json.loads(read_file(folder, CORRELATIONS))
        found = []
        for row in rows:
            values = {key: value for key, value in row.items() if key in known}
            value = _RENAMED_VALUES.get(row["value"], row["value"])
            found.append({**values, "map": by_name[row["name"]], "value": value})
        return TypeAdapter(list[Correlation]).validate_python(found)
    except (FileNotFoundError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise StoreError(f"{folder / CORRELATIONS} cannot be read: `ds report {folder}` writes it again") from None


def network_of(config: CampaignConfig) -> Network | None:
    """Find the paper's heading for the configured network; None if the paper does not test it."""
    architecture = architecture_of(config.driver)
    return (architecture, kind_of(config.driver)) if architecture in NETWORKS else None


def tables_of(
    config: CampaignConfig,
    maps: Mapping[MapId, FeatureMap],
    correlations: Sequence[Correlation],
    added: Sequence[PairedDifference],
) -> list[Table]:
    """Tabulate RQ2, RQ3, paired differences if siblings are merged, and robustness checks; empty without a twin."""
    if config.twin is None:
        return []
    return [
        *correlation_tables(correlations, config.siblings, config.twin, network_of(config)),
        *([paired_difference_table(added, config.siblings)] if added else []),
        robustness_table(check_robustness(maps, config.siblings, config.twin), cautions(correlations)),
    ]


IN_WORDS = {
    GateState.NOT_APPLICABLE: "not applicable",
    GateState.INFEASIBLE: "infeasible",
    GateState.OUT_OF_ODD: "out of the operational design domain",
}
"""States of excluded tests, in words."""


def exclusion_counts(data: CampaignData) -> dict[str, dict[str, int]]:
    """Count excluded tests by simulator and state; simulators without any are left out."""
    found = Counter((simulator, gate.state) for (_, simulator), gate in data.excluded.items())
    counts = {name: {state.value: found[name, state] for state in IN_WORDS} for name in data.config.simulators}
    return {name: {state: n for state, n in of.items() if n} for name, of in counts.items() if any(of.values())}


def exclusion_lines(data: CampaignData) -> list[str]:
    """Describe excluded tests, one line for each simulator that has any."""
    judged = Counter(simulator for _, simulator in data.gates)
    return [
        f"{name}: {sum(counts.values())} of {judged[name]} gated tests enter no map: "
        + ", ".join(f"{n} {IN_WORDS[GateState(state)]}" for state, n in counts.items())
        for name, counts in exclusion_counts(data).items()
    ]


def excluded_table(data: CampaignData) -> Table:
    """Tabulate excluded tests, one row per test and simulator."""
    conditions = {test.test_id: format_conditions(test.conditions) for test in data.tests}
    return Table(
        name="excluded_tests",
        title="Tests by which no network can be judged",
        columns=[
            Column("test"),
            Column("simulator"),
            Column("state"),
            Column("why"),
            Column("line contrast at the start", "number"),
            Column("share of road with invisible lines", "number"),
            Column("conditions"),
        ],
        rows=[
            (
                test_id,
                simulator,
                IN_WORDS[gate.state],
                gate.message,
                None if gate.outcome is None else gate.visible_contrast,
                None if gate.outcome is None else gate.hidden_share,
                conditions.get(test_id, ""),
            )
            for (test_id, simulator), gate in data.excluded.items()
        ],
    )
