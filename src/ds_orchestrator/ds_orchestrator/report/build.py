"""A campaign's results on disk: maps as JSON and pictures, the comparison with the twin as tables, and the report."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Collection
from dataclasses import asdict
from pathlib import Path

from ds_orchestrator.campaign.folder import STAGES, config_of, refuse_foreign_files
from ds_orchestrator.evaluation.campaign_evaluation import (
    correlations_of,
    maps_of,
    network_of,
    paired_differences_of,
    tables_of,
)
from ds_orchestrator.evaluation.table import read_tables, write_tables
from ds_orchestrator.maps.feature_map import FeatureMap, to_json
from ds_orchestrator.store.store import Store
from ds_sim.registry import UntrustedSimulatorError, label_of, received_simulator

RQ1 = Path("evaluation/rq1.json")
"""Where `ds evaluate --data` leaves the tables of RQ1 for the report, relative to the campaign's folder."""
NOT_MADE = -1
"""Executions of which a result was made that is not there or not whole."""


def write_json(folder: Path, maps: dict[str, FeatureMap]) -> None:
    """Write `maps/<name>.json` and `maps/maps.json`."""
    out = folder / "maps"
    out.mkdir(exist_ok=True)
    document = to_json(maps)
    for name, content in document.items():
        (out / f"{label_of(name)}.json").write_text(_text(content))
    (out / "maps.json").write_text(_text(document))


def write_all(
    folder: Path,
    store: Store,
    *,
    again: bool = True,
    say: Callable[[str], None] = lambda line: None,
    trusted: Collection[str] = (),
) -> Path:
    """Make maps, evaluation and report of what the store holds.

    Args:
        folder: of the campaign.
        store: what was done, finished or not.
        again: also what was made already of as many executions; otherwise only what is missing.
        say: told the stage that begins.
        trusted: simulators of the user's own whose code may run; of others no camera picture is made.

    Returns:
        The path of the report.
    """
    from ds_orchestrator.maps.heatmap import write_maps
    from ds_orchestrator.report.html_report import write_report

    config, count = config_of(store), store.count_executions()
    report = folder / "report.html"
    made = {stage for stage, executions in store.results().items() if executions == count}
    if not again and made >= set(STAGES) and report.exists():
        return report
    refuse_foreign_files(folder)
    for name in config.simulators:
        try:
            received_simulator(name, confirmed=trusted, option="--trust")
        except UntrustedSimulatorError as error:
            say(f"report without its pictures: {error}")
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
    added = paired_differences_of(config, maps)
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
    write_report(
        folder,
        store,
        config,
        maps,
        correlations,
        paired_differences=added,
        tables=tables,
        network=network_of(config),
        trusted=trusted,
    )
    store.set_result("report", count)
    return report


def _text(value: object) -> str:
    return json.dumps(value, indent=1, allow_nan=False) + "\n"
