# SPDX-License-Identifier: Apache-2.0
"""Evaluates a campaign: comparison of its maps with the twin's, and tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from ds_analysis.common.statistics import RESAMPLES
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
from ds_base.bounded_json import load_json
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


def correlations_of(config: CampaignConfig, maps: Mapping[MapId, FeatureMap]) -> list[Correlation]:
    """Compare the siblings' maps with the twin's; empty without a twin."""
    return evaluate(maps, config.siblings, config.twin, resamples=RESAMPLES) if config.twin else []


def paired_differences_of(config: CampaignConfig, maps: Mapping[MapId, FeatureMap]) -> list[PairedDifference]:
    """Compute the paired differences between the merged map and each sibling's; empty without a twin."""
    return paired_differences(maps, config.siblings, config.twin) if config.twin else []


def read_correlations(folder: Path, config: CampaignConfig) -> list[Correlation]:
    """Read correlations that this version or an earlier one wrote.

    Raises:
        StoreError: the file is damaged.
    """
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
    """Find the paper's heading for a network; None if the paper does not test it."""
    architecture = architecture_of(driver)
    return (architecture, kind_of(driver)) if architecture in NETWORKS else None


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
        *correlation_tables(correlations, config.siblings, config.twin, network_of(config.driver)),
        *([paired_difference_table(added, config.siblings)] if added else []),
        robustness_table(check_robustness(maps, config.siblings, config.twin), cautions(correlations)),
    ]
