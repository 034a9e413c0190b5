"""`ds demo`, `ds campaign run, resume, status, roads`, `ds report`: campaigns, their state, and their roads."""

from __future__ import annotations

import json
import time
from contextlib import closing
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from ds_cli.campaign.pass_options import (
    FailOnFailure,
    Junit,
    MaxFailures,
    check_writable,
    criteria_of,
    unmet_in_campaign,
)
from ds_cli.options import (
    AttachFlag,
    Cluster,
    EngineName,
    Folder,
    JsonFlag,
    OutFolder,
    Trust,
    Workers,
    cluster_of,
    with_engine,
)
from ds_cli.output import Interrupted, Result, answer, duration, end, say

if TYPE_CHECKING:
    from ds_analysis.comparison.criteria import Criteria
    from ds_orchestrator.campaign.config import CampaignConfig
    from ds_orchestrator.engines.cluster import ClusterOptions
    from ds_orchestrator.store.store import Store

DEMO_WORKERS = 2
"""Graphs of the demo; chosen: with one, the twin drives alone at the end, on one core of two."""

app = typer.Typer()
campaign_app = typer.Typer()


def campaign(
    config: CampaignConfig, out: Path, *, attach: bool = False, cluster: ClusterOptions | None = None
) -> Result:
    """Run a campaign to its report, or resume it.

    Raises:
        Interrupted: the user stopped it.
    """
    from ds_analysis.paper.campaign_evaluation import network_of
    from ds_analysis.paper.paper_tables import correlation_tables
    from ds_cli.progress import ScreenListener
    from ds_orchestrator.campaign.executor import Stopped
    from ds_studies.whole_campaign import run_campaign

    started = time.monotonic()
    listener = ScreenListener()
    try:
        with listener:
            outcome = run_campaign(config, out, listener, attach=attach, cluster=cluster, say=say)
    except (KeyboardInterrupt, Stopped):
        known = (out / "campaign.sqlite").is_file()
        raise Interrupted(_kept(out, listener.done) if known else "") from None
    say(f"finished in {duration(time.monotonic() - started)}")
    document: dict[str, Any] = {
        "folder": str(out),
        "report": str(outcome.report),
        "executions": outcome.executions,
        "executions_in_error": outcome.executions_in_error,
        "correlations": [c.document() for c in outcome.correlations],
    }
    tables = (
        correlation_tables(outcome.correlations, config.siblings, config.twin, network_of(config))
        if config.twin
        else []
    )

    def show() -> None:
        for table in tables:
            table.show(Console())
        print(outcome.report)

    return Result(document=document, show=show, error=outcome.executions_in_error > 0)


def judged(result: Result, folder: Path, criteria: Criteria, junit: Path | None) -> Result:
    """Hold a finished campaign against pass criteria, and write its outcomes as JUnit XML."""
    if criteria == type(criteria)() and junit is None:
        return result
    from ds_analysis.comparison.junit import cases_of_campaign, junit_of
    from ds_orchestrator.campaign.folder import open_store, read_campaign

    with closing(open_store(folder)) as store:
        data = read_campaign(store)
    if junit is not None:
        junit.write_text(junit_of(data.config.driver, cases_of_campaign(data)), "utf-8")
    return replace(result, unmet=unmet_in_campaign(criteria, data))


def _kept(out: Path, done: int) -> str:
    finished = f"{done} finished execution{'s are' if done != 1 else ' is'} kept; " if done else ""
    return f"{finished}`ds campaign resume {out}` continues"


def stored_config(folder: Path, trust: list[str] | None) -> CampaignConfig:
    """Read the configuration of a campaign folder; the code that it names is shipped or trusted."""
    from ds_orchestrator.campaign.folder import config_of, open_store, with_kept_engine
    from ds_studies.whole_campaign import check_trust

    with closing(open_store(folder)) as store:
        config = with_kept_engine(folder, config_of(store))
    check_trust(config, trust or [])
    return config


def status(folder: Path) -> Result:
    """Report how far a campaign is, stage by stage."""
    from ds_orchestrator.campaign.folder import open_store

    with closing(open_store(folder)) as store:
        return _status(folder, store)


def _status(folder: Path, store: Store) -> Result:
    from ds_analysis.paper.exclusions import exclusion_counts, exclusion_lines
    from ds_orchestrator.campaign.folder import read_campaign
    from ds_orchestrator.campaign.selection import missing_bags, missing_line
    from ds_orchestrator.campaign.status import stages_of

    data = read_campaign(store)
    config, executions = data.config, data.executions
    counts: dict[str, dict[str, int]] = {name: {} for name in config.simulators}
    for execution in executions:
        of_simulator = counts.setdefault(execution.simulator, {})
        of_simulator[execution.outcome.name] = of_simulator.get(execution.outcome.name, 0) + 1
    stages = stages_of(data)
    missing = missing_bags(folder, executions)
    driving = [stage.expected for stage in stages if stage.failures is not None]
    known = sum(n for n in driving if n is not None) if None not in driving else config.executions_at_most
    document: dict[str, Any] = {
        "executions": len(executions),
        "executions_in_all": known,
        "stages": [{**asdict(stage), "state": stage.state} for stage in stages],
        "searches": [dict(zip(("sibling", "run", "method", "seed"), row, strict=True)) for row in data.searches],
        "outcomes": counts,
        "excluded": exclusion_counts(data),
        "missing_bags": missing,
        "errors": [
            dict(zip(("test_id", "simulator", "attempt", "outcome", "message"), row, strict=True))
            for row in data.errors
        ],
    }

    def show() -> None:
        table = Table(title=f"{document['executions']} of {document['executions_in_all']} executions")
        for column in ("stage", "state", "done", "of", "failures", *(("excluded",) if data.excluded else ())):
            table.add_column(column, justify="left" if column in ("stage", "state") else "right")
        for stage in stages:
            numbers: tuple[int | None, ...] = (stage.done, stage.expected, stage.failures)
            numbers += (stage.excluded,) if data.excluded else ()
            numbers = (None,) * len(numbers) if stage.failures is None else numbers
            table.add_row(stage.name, stage.state, *("" if n is None else str(n) for n in numbers))
        Console().print(table)
        for line in exclusion_lines(data):
            print(line)
        if missing:
            print(missing_line(missing))
        if document["errors"]:
            print(f"{len(document['errors'])} attempts ended in an error; --json lists them")

    return Result(document=document, show=show)


def shipped_config(name: str) -> CampaignConfig:
    """Read a configuration that ships with ds_bringup.

    Raises:
        ds_orchestrator.campaign.config.ConfigError: the workspace is not built or not sourced.
    """
    from ds_orchestrator.campaign.config import ConfigError, read_config
    from ds_sim.installation import share_folders

    for folder in share_folders("ds_bringup"):
        path = folder / "config" / f"{name}.yaml"
        if path.exists():
            return read_config(path)
    raise ConfigError(f"{name}.yaml of ds_bringup is not on AMENT_PREFIX_PATH: build and source the workspace")


@app.command("demo")
def demo_command(
    out: OutFolder = Path("demo"),
    workers: Workers = None,
    engine: EngineName = None,
    attach: AttachFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Run a small campaign with the shipped network, from search to report.

    The last line is the path of the HTML report.
    """
    workers = workers or (1 if attach else DEMO_WORKERS)
    end(campaign(with_engine(shipped_config("demo"), workers, engine), out, attach=attach), as_json)


@campaign_app.command("run")
def campaign_run_command(
    config: Annotated[Path, typer.Argument(metavar="CONFIG.yaml", help="Configuration of the campaign.")],
    out: OutFolder,
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="Only say how many drives, how long here and how much disk, from one drive."),
    ] = False,
    fail_on: FailOnFailure = None,
    max_failures: MaxFailures = None,
    junit: Junit = None,
    workers: Workers = None,
    engine: EngineName = None,
    cluster: Cluster = None,
    attach: AttachFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Run a campaign; resume it if the folder holds one with the same configuration."""
    from ds_cli.campaign import prepare
    from ds_orchestrator.campaign.config import ConfigError, read_config

    criteria = criteria_of(fail_on, max_failures, has_reference=False)
    check_writable(junit)
    changed = with_engine(read_config(config), workers, engine)
    if dry_run:
        if attach:
            raise ConfigError("--dry-run starts the engine itself: leave out --attach")
        end(prepare.dry_run(changed, out, cluster_of(cluster)), as_json)
        return
    end(judged(campaign(changed, out, attach=attach, cluster=cluster_of(cluster)), out, criteria, junit), as_json)


@campaign_app.command("resume")
def campaign_resume_command(
    folder: Folder,
    fail_on: FailOnFailure = None,
    max_failures: MaxFailures = None,
    junit: Junit = None,
    workers: Workers = None,
    engine: EngineName = None,
    cluster: Cluster = None,
    attach: AttachFlag = False,
    trust: Trust = None,
    as_json: JsonFlag = False,
) -> None:
    """Resume a campaign that was stopped; with any engine."""
    criteria = criteria_of(fail_on, max_failures, has_reference=False)
    check_writable(junit)
    changed = with_engine(stored_config(folder, trust), workers, engine)
    end(judged(campaign(changed, folder, attach=attach, cluster=cluster_of(cluster)), folder, criteria, junit), as_json)


@campaign_app.command("status")
def campaign_status_command(folder: Folder, as_json: JsonFlag = False) -> None:
    """Show how far a campaign is, stage by stage."""
    answer(status(folder), as_json)


@campaign_app.command("roads")
def campaign_roads_command(
    folder: Folder,
    failed: Annotated[bool, typer.Option("--failed", help="Only roads on which the driver failed.")] = False,
    simulator: Annotated[
        str | None, typer.Option(help="Only roads driven on this simulator; --failed then means failed there.")
    ] = None,
    cell: Annotated[
        str | None, typer.Option(help="Only roads of this cell of the feature map, as on its axes, such as 3,0.17.")
    ] = None,
    test: Annotated[str | None, typer.Option(help="Only the road of this test.")] = None,
    out: Annotated[Path | None, typer.Option(help="File to write; standard output if left out.")] = None,
) -> None:
    """Print a campaign's roads as JSON, as `ds drive --road` and `ds road check` take it.

    Each road comes with its test, seed, cell, and outcome on every simulator. `ds drive --road FILE` with a file of one
    road drives it with the test's seed, which repeats the recorded run.
    """
    from ds_orchestrator.campaign.selection import roads_of

    found = roads_of(folder, failed=failed, simulator=simulator, cell=cell, test=test)
    # One road per line, so that a line can be cut out and driven.
    text = "[\n" + ",\n".join(json.dumps(road, allow_nan=False) for road in found) + "\n]" if found else "[]"
    if out is None:
        print(text)
    else:
        out.write_text(text + "\n", "utf-8")
        print(out)
    say(f"{len(found)} road{'' if len(found) == 1 else 's'}")


@app.command("report")
def report_command(folder: Folder, trust: Trust = None) -> None:
    """Rebuild a campaign's maps, tables and HTML report."""
    from ds_studies.whole_campaign import rebuild_report

    print(rebuild_report(folder, say=say, trusted=trust or []))
