"""A campaign's results on disk: maps as JSON and pictures, the comparison with the twin as tables, and the report."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from ds_orchestrator.config import CampaignConfig, parse_config
from ds_orchestrator.evaluation import RESAMPLES, Correlation, Gain, evaluate, gains, variants
from ds_orchestrator.maps import FeatureMap, campaign_maps, to_json
from ds_orchestrator.paper_tables import NETWORKS, Network, correlation_tables, gain_table, variant_table
from ds_orchestrator.predictions import architecture_of
from ds_orchestrator.store import Store, StoreError
from ds_orchestrator.tables import Table, read_tables, write_tables
from ds_sim.registry import label_of

RQ1 = Path("evaluation/rq1.json")
"""Where `ds evaluate --data` leaves the tables of RQ1 for the report, relative to the campaign's folder."""
STAGES = ("maps", "evaluation", "report")
"""What is made of the executions, in order."""
WRITTEN = ("bags", "logs", "maps", "evaluation", "report.html")
"""What a campaign writes into its folder beside the store."""
NOT_MADE = -1
"""Executions of which a result was made that is not there or not whole."""


def open_store(folder: Path) -> Store:
    """The store of a campaign that was run already.

    Raises:
        StoreError: there is none.
    """
    if not folder.is_dir():
        raise StoreError(f"no folder {folder}: run a campaign there first")
    return Store(folder / "campaign.sqlite")


def prepare_folder(folder: Path) -> None:
    """Make a folder for a campaign if need be, and see that nobody else's files lie where it writes.

    Raises:
        StoreError: it cannot be made, or would be written over.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise StoreError(f"{folder} is a file, expected a folder: choose another --out") from None
    except OSError as error:
        raise StoreError(f"{folder} cannot be made ({error.strerror}): choose another --out") from None
    foreign = [name for name in WRITTEN if (folder / name).exists()]
    if foreign and not (folder / "campaign.sqlite").exists():
        raise StoreError(f"{folder} holds {foreign[0]} and no campaign, it would be written over: choose another --out")


def config_of(store: Store) -> CampaignConfig:
    """The configuration as run."""
    return parse_config(json.loads(store.config), "campaign.sqlite")


def maps_of(store: Store, *, features: Sequence[str] | None = None) -> dict[str, FeatureMap]:
    """Every map of a campaign, finished or not; over other features than its own if wanted."""
    config = config_of(store)
    plan = config.map_plan(frozenset(store.given_up()))
    if features is not None:
        plan = replace(plan, features=tuple(features))
    return campaign_maps(config.siblings, config.twin, store.tests(), store.executions(), plan)


def correlations_of(config: CampaignConfig, maps: dict[str, FeatureMap]) -> list[Correlation]:
    """The comparison with the twin, empty without one."""
    return evaluate(maps, config.siblings, config.twin, resamples=RESAMPLES) if config.twin else []


def gains_of(config: CampaignConfig, maps: dict[str, FeatureMap]) -> list[Gain]:
    """What merging adds to each sibling, empty without a twin."""
    return gains(maps, config.siblings, config.twin) if config.twin else []


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
    config: CampaignConfig, maps: dict[str, FeatureMap], correlations: Sequence[Correlation], added: Sequence[Gain]
) -> list[Table]:
    """RQ2, RQ3, what merging adds if there is something to merge, and variants; empty without a twin."""
    if config.twin is None:
        return []
    return [
        *correlation_tables(correlations, config.siblings, config.twin, network_of(config)),
        *([gain_table(added, config.siblings)] if added else []),
        variant_table(variants(maps, config.siblings, config.twin)),
    ]


def write_json(folder: Path, maps: dict[str, FeatureMap]) -> None:
    """Write `maps/<name>.json` and `maps/maps.json`."""
    out = folder / "maps"
    out.mkdir(exist_ok=True)
    document = to_json(maps)
    for name, content in document.items():
        (out / f"{label_of(name)}.json").write_text(_text(content))
    (out / "maps.json").write_text(_text(document))


def write_all(
    folder: Path, store: Store, *, again: bool = True, say: Callable[[str], None] = lambda line: None
) -> Path:
    """Make maps, evaluation and report of what the store holds.

    Args:
        folder: of the campaign.
        store: what was done, finished or not.
        again: also what was made already of as many executions; otherwise only what is missing.
        say: told the stage that begins.

    Returns:
        The path of the report.
    """
    from ds_orchestrator.pictures import write_maps
    from ds_orchestrator.report import write_report

    config, count = config_of(store), store.count_executions()
    report = folder / "report.html"
    made = {stage for stage, executions in store.results().items() if executions == count}
    if not again and made >= set(STAGES) and report.exists():
        return report
    began = time.monotonic()
    maps = maps_of(store)
    # Half written is not made; a process that ends amid this leaves it to be made again.
    for stage in STAGES:
        store.set_result(stage, NOT_MADE)
    say("stage: maps")
    write_json(folder, maps)
    write_maps(maps, folder / "maps")
    store.set_result("maps", count)
    mapped = time.monotonic()
    say("stage: evaluation")
    correlations = correlations_of(config, maps)
    added = gains_of(config, maps)
    tables = tables_of(config, maps, correlations, added)
    (folder / "maps" / "correlations.json").write_text(_text([asdict(c) for c in correlations]))
    write_tables(tables, folder / "evaluation")
    store.set_result("evaluation", count)
    # What was noted first stays, so that the report is the same when it is written again.
    store.note("seconds maps", f"{mapped - began:.1f}")
    store.note("seconds evaluation", f"{time.monotonic() - mapped:.1f}")
    say("stage: report")
    # RQ1 needs a data set: it is there if `ds evaluate --data` was given one.
    tables = [*read_tables(folder / RQ1), *tables]
    write_report(folder, store, config, maps, correlations, gains=added, tables=tables, network=network_of(config))
    store.set_result("report", count)
    return report


def _text(value: object) -> str:
    return json.dumps(value, indent=1, allow_nan=False) + "\n"
