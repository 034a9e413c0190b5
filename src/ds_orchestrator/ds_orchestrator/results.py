"""A campaign's results on disk: maps as JSON and pictures, the comparison with the twin, and the report."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

from ds_orchestrator.config import CampaignConfig, parse_config
from ds_orchestrator.evaluation import Correlation, evaluate
from ds_orchestrator.maps import FeatureMap, campaign_maps, to_json
from ds_orchestrator.store import Store, StoreError
from ds_sim.registry import label_of


def open_store(folder: Path) -> Store:
    """The store of a campaign that was run already.

    Raises:
        StoreError: there is none.
    """
    if not folder.is_dir():
        raise StoreError(f"no folder {folder}: run a campaign there first")
    return Store(folder / "campaign.sqlite")


def config_of(store: Store) -> CampaignConfig:
    """The configuration as run."""
    return parse_config(json.loads(store.config), "campaign.sqlite")


def maps_of(store: Store) -> dict[str, FeatureMap]:
    """Every map of a campaign, finished or not."""
    config = config_of(store)
    return campaign_maps(config.siblings, config.twin, store.tests(), store.executions())


def correlations_of(config: CampaignConfig, maps: dict[str, FeatureMap]) -> list[Correlation]:
    """The comparison with the twin, empty without one."""
    return evaluate(maps, config.siblings, config.twin) if config.twin else []


def write_json(folder: Path, maps: dict[str, FeatureMap], correlations: list[Correlation]) -> None:
    """Write `maps/<name>.json`, `maps/maps.json` and `maps/correlations.json`."""
    out = folder / "maps"
    out.mkdir(exist_ok=True)
    document = to_json(maps)
    for name, content in document.items():
        (out / f"{label_of(name)}.json").write_text(_text(content))
    (out / "maps.json").write_text(_text(document))
    (out / "correlations.json").write_text(_text([asdict(c) for c in correlations]))


def write_all(folder: Path, store: Store) -> Path:
    """Write maps, pictures and report of what the store holds; the path of the report."""
    from ds_orchestrator.pictures import write_maps
    from ds_orchestrator.report import write_report

    config = config_of(store)
    maps = maps_of(store)
    correlations = correlations_of(config, maps)
    write_json(folder, maps, correlations)
    write_maps(maps, folder / "maps")
    return write_report(folder, store, config, maps, correlations)


def _text(value: object) -> str:
    return json.dumps(value, indent=1, allow_nan=False) + "\n"
