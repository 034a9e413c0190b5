"""The report of a campaign: one HTML file that opens offline and shows what was found, and how."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from plotly.offline import get_plotlyjs

from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.stage_timer import seconds_of
from ds_orchestrator.campaign.status import stages_of
from ds_orchestrator.evaluation.correlation import Correlation, PairedDifference
from ds_orchestrator.evaluation.paper_tables import Network
from ds_orchestrator.evaluation.table import Table
from ds_orchestrator.maps.feature_map import FeatureMap
from ds_orchestrator.report.camera_pictures import (
    CAMERA_PLACE,
    camera_pictures,
    common_test,
    drive_pictures,
    telling_tests,
)
from ds_orchestrator.report.findings import count, summarise
from ds_orchestrator.report.page_data import cells_by_test, in_words, page_data
from ds_orchestrator.report.plotly_figures import correlation_chart, density_chart, layouts
from ds_orchestrator.store.store import Execution, Store, Test
from ds_sim.simulator import Outcome

_VERDICTS = [outcome for outcome in Outcome if outcome.is_verdict]
_SHOWN_ERRORS = 200
"""Rows of a list of what went wrong; chosen: nobody reads more, and the store has them all."""


def write_report(
    folder: Path,
    store: Store,
    config: CampaignConfig,
    maps: Mapping[str, FeatureMap],
    correlations: Sequence[Correlation],
    *,
    paired_differences: Sequence[PairedDifference] = (),
    tables: Sequence[Table] = (),
    network: Network | None = None,
    trusted: Collection[str] = (),
) -> Path:
    """Write `report.html`; the same store gives the same bytes.

    Args:
        folder: of the campaign.
        store: what was done, finished or not.
        config: as run.
        maps: as `ds_orchestrator.maps.campaign_maps.build_maps` makes and names them.
        correlations: with the twin, empty without one.
        paired_differences: what merging adds to each sibling.
        tables: of the evaluation.
        network: whose numbers of the paper stand beside ours, or None.
        trusted: simulators of the user's own whose code may run; the others have no pictures.

    Returns:
        The path of the report.
    """
    tests, executions, notes = store.tests(), store.executions(), store.notes()
    place = common_test(tests, executions)
    data = page_data(config, maps, tests, executions)
    cells = cells_by_test(config, tests, executions)
    shown = telling_tests(tests, executions, cells)
    pictures = drive_pictures(config.simulators, shown, executions, trusted)
    data["pictures"] = {
        test_id: [drive and {"frames": drive.frames, "note": drive.note} for drive in drives]
        for test_id, drives in pictures.items()
    }
    data["layouts"] = layouts(rows=len(data["axes"][1]["begins"]) - 1)
    data["figures"] = _figures(config, correlations, tables, network)
    leftover = _leftover(config, store, tests, executions)
    page = _environment().get_template("report.html.j2")
    text = page.render(
        config=config,
        config_yaml=yaml.safe_dump(config.model_dump(), sort_keys=False, allow_unicode=True),
        findings=summarise(
            config, maps, correlations, executions, tests=len(tests), paired_differences=paired_differences
        ),
        tiles=_tiles(config, correlations, tests, executions),
        cameras=camera_pictures(config.simulators, place, trusted) if place else [],
        camera_test=place,
        camera_cell=cells.get(place.test_id, ()) if place else (),
        camera_place=CAMERA_PLACE,
        data=data,
        plotly=Markup(get_plotlyjs().replace("</script", "<\\/script")),
        pictured=len(shown),
        tables=[table for table in tables if table.rows],
        of_paper=network is not None,
        outcomes=_outcome_table(config, executions),
        verdicts=_VERDICTS,
        stages=stages_of(config, store),
        seconds=seconds_of(notes),
        searches=store.searches(),
        versions={k.removeprefix("version "): v for k, v in notes.items() if k.startswith("version ")},
        notes={k: v for k, v in notes.items() if k != "config" and not k.startswith(("version ", "seconds "))},
        tests=len(tests),
        simulated_seconds=sum(e.simulated_seconds for e in executions),
        errors=store.errors(),
        leftover=leftover,
        shown_errors=_SHOWN_ERRORS,
    )
    path = folder / "report.html"
    path.write_text(text, encoding="utf-8")
    return path


def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("ds_orchestrator.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}
    environment.filters["count"] = count
    environment.filters["in_words"] = in_words
    environment.filters["duration"] = duration
    return environment


def duration(seconds: float) -> str:
    """`4 s`, `3 min 20 s`, `5 h 07 min`."""
    whole = round(seconds)
    if whole < 60:
        return f"{seconds:.0f} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def _figures(
    config: CampaignConfig, correlations: Sequence[Correlation], tables: Sequence[Table], network: Network | None
) -> dict[str, Any]:
    """Charts by name; those that have nothing to show are left out."""
    found = {"correlations": correlation_chart(correlations, config.siblings, network)}
    for table in tables:
        if table.name == "rq1_densities" and table.rows:
            found["densities"] = density_chart(table)
    return {name: chart for name, chart in found.items() if chart is not None}


def _tiles(
    config: CampaignConfig, correlations: Sequence[Correlation], tests: Sequence[Test], executions: Sequence[Execution]
) -> list[tuple[str, str]]:
    """The numbers to take home: value, and what it is."""
    tiles = [(f"{len(tests):,}", "tests, each a road"), (f"{len(executions):,}", "drives with a verdict")]
    for name in config.simulators:
        mine = [e for e in executions if e.simulator == name]
        failed = sum(e.outcome.is_failure for e in mine)
        share = f"{100 * failed / len(mine):.0f} %" if mine else "–"
        tiles.append((share, f"of the drives fail on {name}" + (" (twin)" if name == config.twin else "")))
    merged = next((c for c in correlations if c.name == "merged" and c.value == "probability"), None)
    if merged is not None and merged.r is not None:
        ends = f", 95 %: {merged.r_interval[0]:.2f} to {merged.r_interval[1]:.2f}" if merged.r_interval else ""
        tiles.append((f"r = {merged.r:.2f}", f"merged map against the twin{ends}"))
    return tiles


def _outcome_table(config: CampaignConfig, executions: Sequence[Execution]) -> list[dict[str, Any]]:
    """One row per simulator."""
    rows = []
    for name in config.simulators:
        mine = [e for e in executions if e.simulator == name and e.outcome.is_verdict]
        rows.append(
            {
                "simulator": name,
                "role": "twin" if name == config.twin else "sibling",
                "tests": len(mine),
                "counts": Counter(e.outcome for e in mine),
                "failed": sum(e.outcome.is_failure for e in mine),
                "max_lateral_position": float(np.mean([e.max_lateral_position for e in mine])) if mine else None,
                "seconds": sum(e.simulated_seconds for e in mine),
            }
        )
    return rows


def _leftover(
    config: CampaignConfig, store: Store, tests: Sequence[Test], executions: Sequence[Execution]
) -> list[tuple[str, str, str]]:
    """Tests without an outcome somewhere: test, the simulators that lack one, and why."""
    done = {(e.test_id, e.simulator) for e in executions}
    tried = {(test_id, simulator) for test_id, simulator, *_ in store.errors()}
    given_up = store.given_up()
    rows = []
    for test in tests:
        missing = [name for name in config.simulators if (test.test_id, name) not in done]
        # Where only elites are migrated, a test that stays at home lacks nothing.
        if config.elites_only:
            missing = [name for name in missing if name == test.sibling or (test.test_id, name) in tried]
        if missing:
            failed = [name for name in missing if (test.test_id, name) in tried]
            reason = f"every attempt ended in an error on {', '.join(failed)}" if failed else "not driven yet"
            if test.test_id in given_up:
                reason += "; the search went on without it"
            rows.append((test.test_id, ", ".join(missing), reason))
    return rows
