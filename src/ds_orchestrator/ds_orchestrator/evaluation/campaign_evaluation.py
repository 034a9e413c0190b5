"""Evaluates a campaign: its maps, their comparison with the twin, and the tables of both."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.folder import config_of
from ds_orchestrator.evaluation.correlation import Correlation, PairedDifference, evaluate, paired_differences
from ds_orchestrator.evaluation.offline_predictions import architecture_of
from ds_orchestrator.evaluation.paper_tables import (
    NETWORKS,
    Network,
    correlation_tables,
    paired_difference_table,
    robustness_table,
)
from ds_orchestrator.evaluation.robustness_checks import check_robustness
from ds_orchestrator.evaluation.statistics import RESAMPLES
from ds_orchestrator.evaluation.table import Table
from ds_orchestrator.maps.campaign_maps import build_maps
from ds_orchestrator.maps.feature_map import FeatureMap
from ds_orchestrator.store.store import Store


def maps_of(store: Store, *, features: Sequence[str] | None = None) -> dict[str, FeatureMap]:
    """Every map of a campaign, finished or not; over other features than its own if wanted."""
    config = config_of(store)
    plan = config.map_plan(frozenset(store.given_up()))
    if features is not None:
        plan = replace(plan, features=tuple(features))
    return build_maps(config.siblings, config.twin, store.tests(), store.executions(), plan)


def correlations_of(config: CampaignConfig, maps: dict[str, FeatureMap]) -> list[Correlation]:
    """The comparison with the twin, empty without one."""
    return evaluate(maps, config.siblings, config.twin, resamples=RESAMPLES) if config.twin else []


def paired_differences_of(config: CampaignConfig, maps: dict[str, FeatureMap]) -> list[PairedDifference]:
    """What merging adds to each sibling, empty without a twin."""
    return paired_differences(maps, config.siblings, config.twin) if config.twin else []


def read_correlations(folder: Path) -> list[Correlation]:
    """What `write_all` wrote of the comparison with the twin."""
    rows: list[dict[str, Any]] = json.loads((folder / "maps" / "correlations.json").read_text())
    found = []
    for row in rows:
        intervals = {key: tuple(row[key]) if row[key] else None for key in ("r_interval", "auc_interval")}
        found.append(Correlation(**{**row, **intervals}))
    return found


def network_of(config: CampaignConfig) -> Network | None:
    """Under which heading the paper has this network, or None if it does not test it."""
    architecture = architecture_of(config.driver)
    return (architecture, "real" if config.sim2real else "sim") if architecture in NETWORKS else None


def tables_of(
    config: CampaignConfig,
    maps: dict[str, FeatureMap],
    correlations: Sequence[Correlation],
    added: Sequence[PairedDifference],
) -> list[Table]:
    """RQ2, RQ3, what merging adds if there is something to merge, and robustness_checks; empty without a twin."""
    if config.twin is None:
        return []
    return [
        *correlation_tables(correlations, config.siblings, config.twin, network_of(config)),
        *([paired_difference_table(added, config.siblings)] if added else []),
        robustness_table(check_robustness(maps, config.siblings, config.twin)),
    ]
