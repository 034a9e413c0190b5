"""`ds demo`, `ds campaign init, run, resume`: campaigns, from their configuration to their report."""

from __future__ import annotations

import shlex
import sys
import tempfile
import time
from contextlib import closing
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from ds_cli.campaign.compare_results import (
    FailOnFailure,
    Junit,
    MaxFailures,
    Videos,
    check_writable,
    criteria_of,
    unmet_in_campaign,
)
from ds_cli.options import (
    SHIPPED_SIMULATORS,
    AttachFlag,
    Cluster,
    EngineName,
    Folder,
    JsonFlag,
    OutFolder,
    Trust,
    Workers,
    cluster_of,
    simulators_of,
    with_engine,
)
from ds_cli.output import Interrupted, Result, duration, end, say

if TYPE_CHECKING:
    from ds_analysis.comparison.ci_results import Criteria
    from ds_orchestrator.campaign.config import CampaignConfig
    from ds_orchestrator.engines.cluster import ClusterOptions

DEMO_WORKERS = 2
"""Graphs of the demo; chosen: with one, the twin drives alone at the end, on one core of two."""

DRIVER, SIMULATORS, SIZE = "dave2", "bullet,softbody,donkey", "small"
"""Answers if somebody only presses Enter."""

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
    from ds_orchestrator.engines.preflight import faster_choice
    from ds_studies.whole_campaign import run_campaign

    if faster := faster_choice(config.driver, config.engine):
        say(faster)
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


def judged(result: Result, folder: Path, criteria: Criteria, junit: Path | None, videos: Path | None = None) -> Result:
    """Hold a finished campaign against pass criteria; write its outcomes as JUnit XML, and videos of failures."""
    if criteria == type(criteria)() and junit is None and videos is None:
        return result
    from ds_analysis.comparison.ci_results import cases_of_campaign, junit_of
    from ds_orchestrator.campaign.folder import open_store, read_campaign

    with closing(open_store(folder)) as store:
        data = read_campaign(store)
    if junit is not None:
        junit.write_text(junit_of(data.config.driver, cases_of_campaign(data)), "utf-8")
    if videos is not None:
        from ds_studies.failure_videos import FailedDrive, write_failure_videos

        tests = {test.test_id: test for test in data.tests}
        lost = [(tests[one.test_id], one.simulator) for one in data.verdicts if one.outcome.is_failure]
        failed = [FailedDrive(test.test_id, name, test.road, test.seed, test.conditions) for test, name in lost]
        write_failure_videos(data.config.driver, failed, videos, say)
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


@campaign_app.command("init")
def campaign_init_command(
    file: Annotated[Path, typer.Argument(metavar="FILE.yaml", help="Configuration to write.")] = Path("campaign.yaml"),
    driver: Annotated[
        str | None, typer.Option(help="Network: a name, a .safetensors or .yaml file, or module:Class.")
    ] = None,
    sims: Annotated[
        str | None,
        typer.Option(
            help=f"Siblings, then the twin, separated by commas: of {', '.join(SHIPPED_SIMULATORS)}; or none."
        ),
    ] = None,
    size: Annotated[str | None, typer.Option(help="Search: small, medium or paper.")] = None,
    min_angle: Annotated[
        int | None, typer.Option(min=1, max=360, help="Degrees; larger: more winding roads, such as 200.")
    ] = None,
    max_angle: Annotated[
        int | None, typer.Option(min=1, max=360, help="Degrees; smaller: gentler roads, such as 60.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite the file.")] = False,
) -> None:
    """Write a commented configuration for a network, after three questions or from three options.

    Without a terminal nothing is asked, and what is left out takes the value that Enter would give.
    """
    from ds_orchestrator.campaign.config import ConfigError
    from ds_orchestrator.campaign.template import template
    from ds_orchestrator.engines.preflight import check_driver

    ask = sys.stdin.isatty()
    driver = driver or (typer.prompt("Network", DRIVER, err=True) if ask else DRIVER)
    sims = sims or (typer.prompt("Simulators: siblings, then the twin", SIMULATORS, err=True) if ask else SIMULATORS)
    size = size or (typer.prompt("Search: small, medium or paper", SIZE, err=True) if ask else SIZE)
    if file.exists() and not force:
        raise ConfigError(f"{file} exists already: choose another file, or --force")
    names = simulators_of(sims.removesuffix(",none"))
    check_driver(driver, names)
    siblings, twin = (names[:-1], names[-1]) if len(names) > 1 and not sims.endswith(",none") else (names, None)
    given = {"min_angle": min_angle, "max_angle": max_angle}
    angles = {name: angle for name, angle in given.items() if angle is not None}
    file.write_text(template(driver, siblings, twin, size, angles), "utf-8")
    print(file)
    say(f"next: ds campaign run {shlex.quote(str(file))} --out {shlex.quote(file.stem)} --dry-run")


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
    videos: Videos = None,
    workers: Workers = None,
    engine: EngineName = None,
    cluster: Cluster = None,
    attach: AttachFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Run a campaign; resume it if the folder holds one with the same configuration."""
    from ds_orchestrator.campaign.config import ConfigError, read_config

    criteria = criteria_of(fail_on, max_failures, has_reference=False)
    check_writable(junit)
    changed = with_engine(read_config(config), workers, engine)
    if dry_run:
        if attach:
            raise ConfigError("--dry-run starts the engine itself: leave out --attach")
        end(_dry_run(changed, out, cluster_of(cluster)), as_json)
        return
    end(
        judged(campaign(changed, out, attach=attach, cluster=cluster_of(cluster)), out, criteria, junit, videos),
        as_json,
    )


@campaign_app.command("resume")
def campaign_resume_command(
    folder: Folder,
    fail_on: FailOnFailure = None,
    max_failures: MaxFailures = None,
    junit: Junit = None,
    videos: Videos = None,
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
    end(
        judged(campaign(changed, folder, attach=attach, cluster=cluster_of(cluster)), folder, criteria, junit, videos),
        as_json,
    )


def _dry_run(config: CampaignConfig, out: Path, cluster: ClusterOptions) -> Result:
    """Forecast a campaign from one drive on every simulator; nothing is written.

    Raises:
        Interrupted: the user stopped it.
    """
    from ds_orchestrator.campaign.forecast import measure
    from ds_orchestrator.engines.preflight import preflight
    from ds_orchestrator.engines.start import running_engine

    settings = config.drive_settings(cluster=cluster)
    preflight(settings)
    say(f"{config.executions_at_most} drives at most; measuring one on {', '.join(config.simulators)} each")
    began = time.monotonic()
    try:
        with (
            tempfile.TemporaryDirectory(prefix="ds_forecast_") as logs,
            running_engine(settings, logs=Path(logs), say=say) as engine,
        ):
            found = measure(config, engine, out, start_seconds=time.monotonic() - began)
    except KeyboardInterrupt:
        raise Interrupted from None
    document = {
        **asdict(found),
        "engine": config.engine,
        "workers": config.workers,
        "seconds": round(found.seconds, 1),
        "disk": found.disk,
    }

    def show() -> None:
        gates = f", and {found.gate_drives} of the autopilot for the gates" if found.gate_drives else ""
        workers = f"{config.workers} worker{'' if config.workers == 1 else 's'}"
        print(f"{found.drives} drives at most{gates}, engine {config.engine}, {workers}.")
        print(
            f"About {duration(found.seconds)} on this machine as it is now: "
            + ", ".join(f"{one.simulator} took {duration(one.seconds)}" for one in found.measured)
            + f" for one drive beside the others, and the engine {duration(found.start_seconds)} to start. "
            "Drives that fail are shorter."
        )
        print(f"About {_size(found.disk)} in {out}, report not included; {_size(found.free)} are free.")
        if found.disk > found.free:
            print("That does not fit: free some space, or set record: none.")

    return Result(document=document, show=show)


def _size(count: int) -> str:
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.1f} MB"
