# SPDX-License-Identifier: Apache-2.0
"""Writes a campaign's results: maps as JSON and PNG, the comparison with the twin as tables, and the report."""

from __future__ import annotations

import time
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

from ds_analysis.paper.campaign_contents import excluded_table, maps_of
from ds_analysis.paper.campaign_evaluation import CORRELATIONS, evaluate_campaign, network_of
from ds_base.atomic_files import write_json
from ds_base.progress import logger_of
from ds_base.table import read_tables, write_tables
from ds_orchestrator.campaign.executor import Listener
from ds_orchestrator.campaign.folder import STAGES, CampaignData, read_campaign
from ds_orchestrator.maps.feature_map import to_json
from ds_orchestrator.store.store import Store
from ds_sim.registry import UntrustedSimulatorError, label_of, received_simulator

LOG = logger_of(__name__)

RQ1 = Path("evaluation/rq1.json")
"""File in which `ds evaluate --data` stores the tables of RQ1 for the report, relative to the campaign folder."""
_RENAMED_TABLES = {"rq1_variants": "rq1_robustness_checks"}
"""Name of a table of RQ1 in earlier versions -> present name."""
NOT_MADE = -1
"""Recorded as the number of executions of a result that is missing or incomplete."""


def write_all(
    folder: Path,
    store: Store,
    *,
    data: CampaignData | None = None,
    again: bool = True,
    listener: Listener | None = None,
    trusted: Collection[str] = (),
) -> Path:
    """Write maps, evaluation and report of a campaign, and return the report's path; the caller holds the lock.

    Results that are up to date are written only `again`. Simulators of users that are not trusted have no pictures.
    """
    from ds_report.heatmap import write_maps
    from ds_report.html_report import SHOWN_TESTS, write_report
    from ds_report.sections import answer_section, failure_section, further_map, sibling_section

    report, listener = folder / "report.html", listener or Listener()
    count, results = store.count_results(), store.results()
    if not again and all(results.get(stage) == count for stage in STAGES) and report.exists():
        return report
    data = data or read_campaign(store)
    if len(data.tests) <= SHOWN_TESTS:  # a larger report shows a part of the drives, and depends on no others
        for execution in data.executions:
            _ = execution.trajectory  # damage is found before anything is written
    for name in data.config.simulators:
        try:
            received_simulator(name, confirmed=trusted)
        except UntrustedSimulatorError as error:
            LOG.warning("report without its pictures: %s", error)
    began = time.monotonic()
    maps = maps_of(data)
    # If this process ends early, the mark remains and the results are written again.
    for stage in STAGES:
        store.set_result(stage, NOT_MADE)
    listener.stage("maps")
    for file, content in {**to_json(maps), "maps": to_json(maps)}.items():
        write_json(folder / "maps" / f"{label_of(file)}.json", content)
    write_maps(maps, folder / "maps")
    further_maps = []
    for axes in data.config.further_axes:
        out, further = folder / "maps" / "_by_".join(axes), maps_of(data, features=axes)
        write_maps(further, out)
        write_json(out / "maps.json", to_json(further))
        further_maps.append(further_map(axes, further))
    store.set_result("maps", count)
    mapped = time.monotonic()
    listener.stage("evaluation")
    correlations, differences, tables = evaluate_campaign(data.config, maps)
    write_json(folder / CORRELATIONS, [one.document() for one in correlations])
    siblings = sibling_section(data)
    excluded = [excluded_table(data)] if data.excluded else []
    write_tables([*tables, *(siblings.tables if siblings else ()), *excluded], folder / "evaluation")
    store.set_result("evaluation", count)
    # Keep the times of the first writing, so that rewriting gives an identical report.
    store.note("seconds maps", f"{mapped - began:.1f}")
    store.note("seconds evaluation", f"{time.monotonic() - mapped:.1f}")
    data = replace(data, notes=store.notes())
    listener.stage("report")
    # RQ1 needs a data set; its tables exist after `ds evaluate --data`.
    of_rq1 = [replace(table, name=_RENAMED_TABLES.get(table.name, table.name)) for table in read_tables(folder / RQ1)]
    write_report(
        folder,
        data,
        maps,
        correlations,
        paired_differences=differences,
        tables=[*of_rq1, *tables],
        network=network_of(data.config.driver),
        siblings=siblings,
        answer=answer_section(folder, data),
        failures=failure_section(data),
        further_maps=further_maps,
        trusted=trusted,
    )
    store.set_result("report", count)
    return report
