# SPDX-License-Identifier: Apache-2.0
"""Evaluates a campaign: comparison of its maps with the twin's, and tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import TypeAdapter

from ds_analysis.common.statistics import RESAMPLES
from ds_analysis.paper.correlation import Correlation, PairedDifference, check_robustness, evaluate, paired_differences
from ds_analysis.paper.paper_tables import (
    NETWORKS,
    Network,
    cautions,
    correlation_tables,
    paired_difference_table,
    robustness_table,
)
from ds_base.bounded_file import load_json
from ds_base.folder_files import StoreError, read_file
from ds_base.installation import ds_command
from ds_base.table import Table
from ds_driver.networks.driver_name import DriverName
from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.maps.feature_map import FeatureMap, MapId, map_ids

CORRELATIONS = Path("maps/correlations.json")
"""File with the comparison with the twin, relative to the campaign folder."""
_RENAMED_VALUES = {"quality": "quality_loss"}
"""Value in files of earlier versions -> present name."""


class CampaignEvaluation(NamedTuple):
    """Comparison of a campaign's maps with the twin's, and its tables; empty without a twin."""

    correlations: Sequence[Correlation] = ()
    differences: Sequence[PairedDifference] = ()
    tables: Sequence[Table] = ()


def evaluate_campaign(config: CampaignConfig, maps: Mapping[MapId, FeatureMap]) -> CampaignEvaluation:
    """Compute and tabulate RQ2, RQ3, paired differences if siblings are merged, and robustness checks."""
    if config.twin is None:
        return CampaignEvaluation()
    compared = maps, config.siblings, config.twin
    correlations, differences = evaluate(*compared, resamples=RESAMPLES), paired_differences(*compared)
    tables = [
        *correlation_tables(correlations, config.siblings, config.twin, network_of(config.driver)),
        *([paired_difference_table(differences, config.siblings)] if differences else []),
        robustness_table(check_robustness(*compared), cautions(correlations)),
    ]
    return CampaignEvaluation(correlations, differences, tables)


def read_correlations(folder: Path, config: CampaignConfig) -> list[Correlation]:
    """Read correlations that this version or an earlier one wrote; `StoreError` if the file is damaged."""
    by_name = {map_id.name: map_id for map_id in map_ids(config.siblings, config.twin)}
    keys = {field.name for field in fields(Correlation)}
    try:
        rows: list[dict[str, Any]] = load_json(read_file(folder, CORRELATIONS))
        correlations = []
        for row in rows:
            values = {key: value for key, value in row.items() if key in keys}
            value = _RENAMED_VALUES.get(row["value"], row["value"])
            correlations.append({**values, "map": by_name[row["name"]], "value": value})
        return TypeAdapter(list[Correlation]).validate_python(correlations)
    except (FileNotFoundError, ValueError, KeyError, TypeError, AttributeError):
        raise StoreError(
            f"{folder / CORRELATIONS} cannot be read: `{ds_command('report', folder)}` writes it again"
        ) from None


def network_of(driver: DriverName) -> Network | None:
    """Find the paper's heading for a network, M_S if it sees plain images, M_R translated ones; None for any other."""
    from ds_driver.networks.network_driver import sees_translated
    from ds_driver.networks.weights import architecture_in, shipped_networks

    architecture = architecture_in(shipped_networks().get(driver.network, Path(driver.network)))
    return (architecture, "real" if sees_translated(driver) else "sim") if architecture in NETWORKS else None
