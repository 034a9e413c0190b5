"""`ds demo`, `ds campaign`, `ds maps`, `ds report`: campaigns and what came out of them."""

from __future__ import annotations

import os
import time
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from ds_driver.driving import AUTOPILOT
from ds_orchestrator import results
from ds_orchestrator.campaign import Campaign, Stopped
from ds_orchestrator.commands.answers import Interrupted, Result, answer, end, say
from ds_orchestrator.commands.options import AttachFlag, Folder, JsonFlag, OutFolder
from ds_orchestrator.config import MOST_WORKERS, CampaignConfig, ConfigError, read_config
from ds_orchestrator.features import feature_of
from ds_orchestrator.lock import only_one
from ds_orchestrator.paper_tables import correlation_tables
from ds_orchestrator.progress import ScreenWatcher
from ds_orchestrator.stage_times import StageClock
from ds_orchestrator.store import Store
from ds_orchestrator.versions import versions

Workers = Annotated[
    int | None,
    typer.Option(
        min=1,
        max=MOST_WORKERS,
        help="Graphs that drive at the same time, instead of the configuration's; results do not depend on it.",
    ),
]

app = typer.Typer()
campaign_app = typer.Typer(help="Campaigns: run, resume, look at.", no_args_is_help=True)
app.add_typer(campaign_app, name="campaign")


def run_campaign(config: CampaignConfig, out: Path, *, attach: bool = False) -> Result:
    """Run a campaign to its report, or go on with it.

    Raises:
        Interrupted: the user stopped it; what was finished is kept.
    """
    from ds_orchestrator.graph_plan import check_driver
    from ds_sim.registry import make_simulator

    if attach and config.workers > 1:
        raise ConfigError(f"workers: {config.workers} with nodes that run already, expected 1: leave out --attach")
    check_driver(config.driver)
    for name in config.simulators:
        make_simulator(name).close()
    results.prepare_folder(out)
    with only_one(out), closing(Store(out / "campaign.sqlite", config=config.identity())) as store:
        return _run_campaign(config, out, store, attach=attach)


def _run_campaign(config: CampaignConfig, out: Path, store: Store, *, attach: bool) -> Result:
    from ds_driver.network_driver import driver_sha256
    from ds_orchestrator.stages import is_driven

    if config.driver != AUTOPILOT:
        weights = driver_sha256(config.driver)
        if store.note("sha256 of the driver's weights", weights) != weights:
            raise ConfigError(f"the weights of {config.driver} have changed since {out} began: choose another --out")
    for name, version in versions().items():
        if store.note(f"version {name}", version) != version:
            store.note(f"version {name}, later", version)
    _note_parameter_files(store, config)
    (out / "bags").mkdir(exist_ok=True)
    in_error = 0 if is_driven(config, store) else _drive(config, out, store, attach=attach)
    report = results.write_all(out, store, again=False, say=say)
    found = results.read_correlations(out)
    document: dict[str, Any] = {
        "folder": str(out),
        "report": str(report),
        "executions": len(store.executions()),
        "executions_in_error": in_error,
        "correlations": [asdict(c) for c in found],
    }
    tables = correlation_tables(found, config.siblings, config.twin, results.network_of(config)) if config.twin else []

    def show() -> None:
        for table in tables:
            table.show(Console())
        print(report)

    return Result(document=document, show=show, error=in_error > 0)


def _drive(config: CampaignConfig, out: Path, store: Store, *, attach: bool) -> int:
    """Drive what is not driven yet, on graphs of our own or on the one that runs; how much of it ended in errors."""
    from ds_orchestrator.graph_plan import namespaces_of
    from ds_orchestrator.running import running_graph, running_workers

    namespaces = namespaces_of(config.siblings, config.twin)
    started = time.monotonic()
    try:
        graphs = (
            running_workers(
                config.workers, namespaces, config.driver, command_timeout=config.command_timeout, logs=out / "logs"
            )
            if config.workers > 1
            else running_graph(
                namespaces, config.driver, command_timeout=config.command_timeout, logs=out / "logs", attach=attach
            )
        )
        with graphs as executor, ScreenWatcher() as watcher:
            clock = StageClock(watcher, store)
            campaign = Campaign(config, out, store, executor, clock, namespaces)
            try:
                campaign.run()
            except BaseException:
                executor.stop()
                raise
            finally:
                clock.end()
    except (KeyboardInterrupt, Stopped):
        raise Interrupted from None
    say(f"executed in {time.monotonic() - started:.0f} s")
    return campaign.failed_executions


def _note_parameter_files(store: Store, config: CampaignConfig) -> None:
    """Remember what is in each simulator's parameter file; a campaign does not go on with another car."""
    from ds_sim.registry import make_simulator

    known = store.notes()
    for name in config.simulators:
        if "@" in name:
            key, content = f"car {name}", str(make_simulator(name).spec.extra.get("car", ""))
            if known.get(key, content) != content:
                raise ConfigError(f"{name}: the file has changed since the campaign began: restore it or begin anew")
            store.note(key, content)


def stored_config(folder: Path) -> CampaignConfig:
    """The configuration of a campaign that was begun."""
    with closing(results.open_store(folder)) as store:
        return results.config_of(store)


def status(folder: Path) -> Result:
    """How far a campaign is, stage by stage."""
    with closing(results.open_store(folder)) as store:
        return _status(store)


def _status(store: Store) -> Result:
    from ds_orchestrator.stages import stages_of

    config = results.config_of(store)
    executions = store.executions()
    counts: dict[str, dict[str, int]] = {name: {} for name in config.simulators}
    for execution in executions:
        counts[execution.simulator][execution.outcome.name] = (
            counts[execution.simulator].get(execution.outcome.name, 0) + 1
        )
    stages = stages_of(config, store)
    driving = [stage.expected for stage in stages if stage.failures is not None]
    known = sum(n for n in driving if n is not None) if None not in driving else config.executions_at_most
    document: dict[str, Any] = {
        "executions": len(executions),
        "executions_in_all": known,
        "stages": [{**asdict(stage), "state": stage.state} for stage in stages],
        "searches": [dict(zip(("sibling", "run", "method", "seed"), row, strict=True)) for row in store.searches()],
        "outcomes": counts,
        "errors": [
            dict(zip(("test_id", "simulator", "attempt", "outcome", "message"), row, strict=True))
            for row in store.errors()
        ],
    }

    def show() -> None:
        table = Table(title=f"{document['executions']} of {document['executions_in_all']} executions")
        for column in ("stage", "state", "done", "of", "failures"):
            table.add_column(column, justify="left" if column in ("stage", "state") else "right")
        for stage in stages:
            numbers = (stage.done, stage.expected, stage.failures) if stage.failures is not None else (None,) * 3
            table.add_row(stage.name, stage.state, *("" if n is None else str(n) for n in numbers))
        Console().print(table)
        if document["errors"]:
            print(f"{len(document['errors'])} attempts ended in an error; --json lists them")

    return Result(document=document, show=show)


def maps(folder: Path) -> Result:
    """Every map of a campaign."""
    from ds_orchestrator.maps import to_json

    with closing(results.open_store(folder)) as store:
        document: dict[str, Any] = to_json(results.maps_of(store))

    def show() -> None:
        for name, content in document.items():
            table = Table(title=name)
            features = [feature_of(name) for name in content["features"]]
            columns = [*(f.title for f in features), "tests", "failures", "probability", "95 %", "quality"]
            for column in columns:
                table.add_column(column, justify="right")
            for cell in content["cells"]:
                interval = cell["interval"]
                table.add_row(
                    *(feature.label(cell[feature.name]) for feature in features),
                    str(cell["tests"]),
                    "" if cell["failures"] is None else str(cell["failures"]),
                    f"{cell['probability']:.2f}",
                    "" if interval is None else f"{interval[0]:.2f}, {interval[1]:.2f}",
                    f"{cell['quality']:.2f}",
                )
            Console().print(table)

    return Result(document=document, show=show)


def report(folder: Path) -> Path:
    """Write maps, pictures and report again."""
    with closing(results.open_store(folder)) as store:
        return results.write_all(folder, store, say=say)


def _with(config: CampaignConfig, workers: int | None) -> CampaignConfig:
    """The configuration with another number of workers."""
    return config if workers is None else config.model_copy(update={"workers": workers})


def shipped_config(name: str) -> CampaignConfig:
    """A configuration that comes with ds_bringup."""
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        path = Path(prefix) / "share" / "ds_bringup" / "config" / f"{name}.yaml"
        if path.exists():
            return read_config(path)
    raise ConfigError(f"{name}.yaml of ds_bringup is not on AMENT_PREFIX_PATH: build and source the workspace")


@app.command("demo")
def demo_command(
    out: OutFolder = Path("demo"), workers: Workers = None, attach: AttachFlag = False, as_json: JsonFlag = False
) -> None:
    """The whole method, small, with the shipped network; ends with the path of the report."""
    end(run_campaign(_with(shipped_config("demo"), workers), out, attach=attach), as_json)


@campaign_app.command("run")
def campaign_run_command(
    config: Annotated[Path, typer.Argument(metavar="CONFIG.yaml", help="What to do.")],
    out: OutFolder,
    workers: Workers = None,
    attach: AttachFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Run a campaign, or go on with the one in the folder if it has the same configuration."""
    end(run_campaign(_with(read_config(config), workers), out, attach=attach), as_json)


@campaign_app.command("resume")
def campaign_resume_command(
    folder: Folder, workers: Workers = None, attach: AttachFlag = False, as_json: JsonFlag = False
) -> None:
    """Go on with a campaign that was stopped."""
    end(run_campaign(_with(stored_config(folder), workers), folder, attach=attach), as_json)


@campaign_app.command("status")
def campaign_status_command(folder: Folder, as_json: JsonFlag = False) -> None:
    """How far a campaign is."""
    answer(status(folder), as_json)


@app.command("maps")
def maps_command(folder: Folder, as_json: JsonFlag = False) -> None:
    """Every feature map of a campaign."""
    answer(maps(folder), as_json)


@app.command("report")
def report_command(folder: Folder) -> None:
    """Write the report of a campaign again."""
    print(report(folder))
