# SPDX-License-Identifier: Apache-2.0
"""Writes the results of a campaign: maps, the comparison with the twin as tables, and the report, one HTML file."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from markupsafe import Markup
from plotly.offline import get_plotlyjs

from ds_analysis.common.selection import Share
from ds_analysis.common.statistics import families_of
from ds_analysis.paper.campaign_contents import excluded_table, exclusion_lines, maps_of
from ds_analysis.paper.correlation import Correlation, PairedDifference
from ds_analysis.paper.paper_tables import CORRELATIONS, Network, cautions, evaluate_campaign, network_of
from ds_base.folder_files import write_json
from ds_base.progress import logger_of
from ds_base.table import Table, read_tables, write_tables
from ds_orchestrator.campaign.executor import Listener
from ds_orchestrator.campaign.folder import STAGES, CampaignData, read_campaign
from ds_orchestrator.campaign.status import stages_of
from ds_orchestrator.maps.feature_map import FeatureMap, MapId, to_json
from ds_orchestrator.store.store import Store, seconds_of
from ds_report import camera_pictures, sections
from ds_report.findings import summarise
from ds_report.first_screen import first_screen
from ds_report.heatmap import write_maps
from ds_report.page_data import page_data
from ds_report.pages import write_page
from ds_report.plotly_figures import correlation_chart, density_chart, layouts
from ds_sim.registry import UntrustedSimulatorError, label_of, received_simulator
from ds_sim.simulator import Outcome

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
        further_maps.append(sections.further_map(axes, further))
    store.set_result("maps", count)
    mapped = time.monotonic()
    listener.stage("evaluation")
    correlations, differences, tables = evaluate_campaign(data.config, maps)
    write_json(folder / CORRELATIONS, [one.document() for one in correlations])
    siblings = sections.sibling_section(data)
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
        answer=sections.answer_section(folder, data),
        failures=sections.failure_section(data),
        further_maps=further_maps,
        trusted=trusted,
    )
    store.set_result("report", count)
    return report


_VERDICTS = [outcome for outcome in Outcome if outcome.is_verdict]
SHOWN_TESTS = 2_000
"""Tests whose roads and drives are in the page; chosen: more than the paper's campaigns have, 15 MB."""
_SHOWN_ERRORS = 200
"""Rows of a list of errors; chosen: more are rarely read, and the store has all."""


def write_report(
    folder: Path,
    data: CampaignData,
    maps: Mapping[MapId, FeatureMap],
    correlations: Sequence[Correlation],
    *,
    paired_differences: Sequence[PairedDifference] = (),
    tables: Sequence[Table] = (),
    network: Network | None = None,
    siblings: sections.SiblingSection | None = None,
    answer: sections.AnswerSection | None = None,
    failures: sections.FailureSection | None = None,
    further_maps: Sequence[sections.FurtherMap] = (),
    trusted: Collection[str] = (),
) -> Path:
    """Write `report.html`, with the paper's numbers of a network, and return its path.

    The same campaign gives the same bytes. User-defined simulators that are not trusted have no pictures.
    """
    config, tests, executions, notes = data.config, data.tests, data.executions, data.notes
    completed = Counter(e.test_id for e in executions if e.outcome is Outcome.COMPLETED)
    place = max(tests, key=lambda test: completed[test.test_id], default=None)
    shown = data
    if large := len(tests) > SHOWN_TESTS:
        kept = set(camera_pictures.worst_first(tests, executions)[:SHOWN_TESTS])
        shown = replace(
            data,
            tests=tuple(test for test in tests if test.test_id in kept),
            executions=tuple(execution for execution in executions if execution.test_id in kept),
        )
    on_page = page_data(shown, maps)
    paired = camera_pictures.translates(config.driver)
    # A translated picture stands below the camera's, in an image of twice the size.
    most = (camera_pictures.REPLAYS_OF_LARGE if large else camera_pictures.REPLAY_PICTURES) // (2 if paired else 1)
    plan = camera_pictures.plan_pictures(shown.tests, shown.executions, shown.cells, replays=most)
    pictures = camera_pictures.drive_pictures(
        config.simulators, shown.tests, shown.executions, trusted, config.driver, frames=plan.frames, one_by_one=large
    )
    on_page["pictures"] = {
        test_id: [drive and asdict(drive) for drive in drives] for test_id, drives in pictures.items()
    }
    on_page["paired"] = paired
    on_page["layouts"] = layouts(rows=len(on_page["axes"][1]["begins"]) - 1)
    charts = {"correlations": correlation_chart(correlations, config.siblings, network)}
    for table in tables:
        if table.name == "rq1_densities" and table.rows:
            charts["densities"] = density_chart(table)
    on_page["figures"] = {name: chart for name, chart in charts.items() if chart is not None}
    findings = summarise(data, maps, correlations, paired_differences=paired_differences)
    return write_page(
        folder / "report.html",
        "report.html.j2",
        config=config,
        config_yaml=yaml.safe_dump(config.shown(), sort_keys=False, allow_unicode=True),
        first=first_screen(data, where=findings.headline),
        findings=findings,
        tiles=_tiles(data),
        cameras=[
            camera_pictures.camera_picture(name, place.scenario, trusted, config.driver) for name in config.simulators
        ]
        if place
        else [],
        paired=paired,
        camera_test=place,
        camera_cell=data.cells.get(place.test_id, ()) if place else (),
        camera_place=camera_pictures.CAMERA_PLACE,
        data=on_page,
        plotly=Markup(get_plotlyjs().replace("</script", "<\\/script")),
        plan=plan,
        replay_pictures=most,
        tables=[table for table in tables if table.rows],
        cautions=cautions(correlations),
        of_paper=network is not None,
        siblings=siblings,
        answer=answer,
        failures=failures,
        further_maps=further_maps,
        outcomes=_outcome_table(data.distinct),
        verdicts=_VERDICTS,
        stages=stages_of(data),
        seconds=seconds_of(notes),
        searches=data.searches,
        versions={k.removeprefix("version "): v for k, v in notes.items() if k.startswith("version ")},
        notes={k: v for k, v in notes.items() if k != "config" and not k.startswith(("version ", "seconds "))},
        tests=len(tests),
        shown_tests=len(shown.tests),
        simulated_seconds=sum(e.simulated_seconds for e in executions),
        excluded=excluded_table(data) if data.excluded else None,
        exclusions=exclusion_lines(data),
        errors=data.errors,
        leftover=_leftover(data),
        shown_errors=_SHOWN_ERRORS,
    )


def _tiles(data: CampaignData) -> list[tuple[str, str]]:
    """Collect the key numbers of the first screen: value and caption."""
    repeats, data = len(data.tests) - len(data.distinct.tests), data.distinct
    config, again = data.config, f"; {repeats} more repeat them" if repeats else ""
    a_test = "a road" if all(test.conditions.is_default for test in data.tests) else "a road and its conditions"
    tiles = [
        (f"{len(data.tests):,}", f"test{'' if len(data.tests) == 1 else 's'}, each {a_test}{again}"),
        (f"{len(data.verdicts):,}", f"drive{'' if len(data.verdicts) == 1 else 's'} with a verdict"),
    ]
    families = families_of([test.road for test in data.tests])
    family = dict(zip((test.test_id for test in data.tests), families, strict=True))
    for name in config.simulators:
        judged = [e for e in data.verdicts if e.simulator == name]
        where = name + (" (twin)" if name == config.twin else "")
        if not judged:
            tiles.append(("–", f"no drive on {where}"))
            continue
        failed = np.array([e.outcome.is_failure for e in judged])
        low, high = Share.of(failed, np.array([family[e.test_id] for e in judged])).interval
        ends = f"95%: {100 * low:.0f} to {100 * high:.0f}%"
        tiles.append((f"{100 * failed.mean():.0f}%", f"{failed.sum()} of {len(failed)} fail on {where}, {ends}"))
    return tiles


def _outcome_table(data: CampaignData) -> list[dict[str, Any]]:
    """Count outcomes, one row per simulator."""
    rows = []
    for name, failed in data.failures.items():
        judged = [e for e in data.verdicts if e.simulator == name]
        rows.append(
            {
                "simulator": name,
                "role": "twin" if name == data.config.twin else "sibling",
                "tests": failed.tests,
                "counts": Counter(e.outcome for e in judged),
                "failed": failed.failures,
                "max_lateral_position": float(np.mean([e.max_lateral_position for e in judged])) if judged else None,
                "seconds": sum(e.simulated_seconds for e in judged),
            }
        )
    return rows


def _leftover(data: CampaignData) -> list[tuple[str, str, str]]:
    """List tests that lack an outcome: test, the simulators without one, and the reason."""
    config = data.config
    done = {(e.test_id, e.simulator) for e in data.executions} | set(data.excluded)
    tried = {(test_id, simulator) for test_id, simulator, *_ in data.errors}
    rows = []
    for test in data.tests:
        missing = [name for name in config.simulators if (test.test_id, name) not in done]
        # If only elites migrate, other tests need no outcome elsewhere.
        if config.elites_only:
            missing = [name for name in missing if name == test.sibling or (test.test_id, name) in tried]
        if missing:
            failed = [name for name in missing if (test.test_id, name) in tried]
            reason = f"every attempt ended in an error on {', '.join(failed)}" if failed else "not driven yet"
            if test.test_id in data.given_up:
                reason += "; the search continued without it"
            rows.append((test.test_id, ", ".join(missing), reason))
    return rows
