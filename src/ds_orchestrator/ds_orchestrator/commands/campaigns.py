"""`ds demo`, `ds campaign`, `ds maps`, `ds evaluate`, `ds report`: campaigns and what came out of them."""

from __future__ import annotations

import os
import time
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
from ds_orchestrator.config import CampaignConfig, ConfigError, read_config
from ds_orchestrator.lock import only_one
from ds_orchestrator.progress import ScreenWatcher
from ds_orchestrator.store import Store
from ds_orchestrator.versions import versions

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

    check_driver(config.driver)
    for name in config.simulators:
        make_simulator(name).close()
    out.mkdir(parents=True, exist_ok=True)
    with only_one(out):
        return _run_campaign(config, out, attach=attach)


def _run_campaign(config: CampaignConfig, out: Path, *, attach: bool) -> Result:
    from ds_driver.network_driver import driver_sha256
    from ds_orchestrator.graph_plan import namespaces_of
    from ds_orchestrator.running import running_graph

    store = Store(out / "campaign.sqlite", config=config.model_dump_json())
    if config.driver != AUTOPILOT:
        weights = driver_sha256(config.driver)
        if store.note("sha256 of the driver's weights", weights) != weights:
            raise ConfigError(f"the weights of {config.driver} have changed since {out} began: choose another --out")
    for name, version in versions().items():
        if store.note(f"version {name}", version) != version:
            store.note(f"version {name}, later", version)
    _note_parameter_files(store, config)
    (out / "bags").mkdir(exist_ok=True)
    namespaces = namespaces_of(config.siblings, config.twin)
    started = time.monotonic()
    try:
        with (
            running_graph(
                namespaces, config.driver, command_timeout=config.command_timeout, logs=out / "logs", attach=attach
            ) as executor,
            ScreenWatcher(Campaign.executions_in_all(config)) as watcher,
        ):
            campaign = Campaign(config, out, store, executor, watcher, namespaces)
            try:
                campaign.run()
            except BaseException:
                executor.stop()
                raise
    except (KeyboardInterrupt, Stopped):
        store.close()
        raise Interrupted from None
    say(f"executed in {time.monotonic() - started:.0f} s; drawing maps and report")
    report = results.write_all(out, store)
    document: dict[str, Any] = {
        "folder": str(out),
        "report": str(report),
        "executions": len(store.executions()),
        "executions_in_error": campaign.failed_executions,
        "correlations": [asdict(c) for c in results.correlations_of(config, results.maps_of(store))],
    }
    table = _correlation_table(document["correlations"])
    store.close()

    def show() -> None:
        Console().print(table)
        print(report)

    return Result(document=document, show=show, error=campaign.failed_executions > 0)


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
    store = results.open_store(folder)
    config = results.config_of(store)
    store.close()
    return config


def status(folder: Path) -> Result:
    """How far a campaign is."""
    store = results.open_store(folder)
    config = results.config_of(store)
    executions = store.executions()
    counts: dict[str, dict[str, int]] = {name: {} for name in config.simulators}
    for execution in executions:
        counts[execution.simulator][execution.outcome.name] = (
            counts[execution.simulator].get(execution.outcome.name, 0) + 1
        )
    document: dict[str, Any] = {
        "executions": len(executions),
        "executions_in_all": Campaign.executions_in_all(config),
        "outcomes": counts,
        "errors": [
            dict(zip(("test_id", "simulator", "attempt", "outcome", "message"), row, strict=True))
            for row in store.errors()
        ],
    }
    store.close()

    def show() -> None:
        table = Table(title=f"{document['executions']} of {document['executions_in_all']} executions")
        for column in ("simulator", "outcome", "tests"):
            table.add_column(column)
        for simulator, outcomes in counts.items():
            for outcome, count in sorted(outcomes.items()):
                table.add_row(simulator, outcome.lower(), str(count))
        Console().print(table)

    return Result(document=document, show=show)


def maps(folder: Path) -> Result:
    """Every map of a campaign."""
    from ds_orchestrator.maps import to_json

    store = results.open_store(folder)
    document: dict[str, Any] = to_json(results.maps_of(store))
    store.close()

    def show() -> None:
        for name, content in document.items():
            table = Table(title=name)
            for column in ("turns", "curvature", "tests", "failures", "probability", "quality"):
                table.add_column(column, justify="right")
            for cell in content["cells"]:
                table.add_row(
                    str(cell["turns_count"]),
                    f"{cell['curvature_bin'] / 100:.2f}",
                    str(cell["tests"]),
                    "" if cell["failures"] is None else str(cell["failures"]),
                    f"{cell['probability']:.2f}",
                    f"{cell['quality']:.2f}",
                )
            Console().print(table)

    return Result(document=document, show=show)


def evaluation(folder: Path) -> Result:
    """Each sibling and the merged map against the twin."""
    store = results.open_store(folder)
    document = [asdict(c) for c in results.correlations_of(results.config_of(store), results.maps_of(store))]
    store.close()
    table = _correlation_table(document)
    return Result(document=document, show=lambda: Console().print(table))


def report(folder: Path) -> Path:
    """Write maps, pictures and report again."""
    store = results.open_store(folder)
    path = results.write_all(folder, store)
    store.close()
    return path


def shipped_config(name: str) -> CampaignConfig:
    """A configuration that comes with ds_bringup."""
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        path = Path(prefix) / "share" / "ds_bringup" / "config" / f"{name}.yaml"
        if path.exists():
            return read_config(path)
    raise ConfigError(f"{name}.yaml of ds_bringup is not on AMENT_PREFIX_PATH: build and source the workspace")


def _correlation_table(rows: list[dict[str, Any]]) -> Table:
    table = Table("map", "against the twin's failures", "cells", "Pearson r", "p", "")
    for row in rows:
        table.add_row(
            row["name"],
            row["value"],
            str(row["cells"]),
            "" if row["r"] is None else f"{row['r']:.3f}",
            "" if row["p"] is None else f"{row['p']:.2g}",
            row["reason"],
        )
    return table


@app.command("demo")
def demo_command(out: OutFolder = Path("demo"), attach: AttachFlag = False, as_json: JsonFlag = False) -> None:
    """The whole method, small, with the shipped network; ends with the path of the report."""
    end(run_campaign(shipped_config("demo"), out, attach=attach), as_json)


@campaign_app.command("run")
def campaign_run_command(
    config: Annotated[Path, typer.Argument(metavar="CONFIG.yaml", help="What to do.")],
    out: OutFolder,
    attach: AttachFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Run a campaign, or go on with the one in the folder if it has the same configuration."""
    end(run_campaign(read_config(config), out, attach=attach), as_json)


@campaign_app.command("resume")
def campaign_resume_command(folder: Folder, attach: AttachFlag = False, as_json: JsonFlag = False) -> None:
    """Go on with a campaign that was stopped."""
    end(run_campaign(stored_config(folder), folder, attach=attach), as_json)


@campaign_app.command("status")
def campaign_status_command(folder: Folder, as_json: JsonFlag = False) -> None:
    """How far a campaign is."""
    answer(status(folder), as_json)


@app.command("maps")
def maps_command(folder: Folder, as_json: JsonFlag = False) -> None:
    """Every feature map of a campaign."""
    answer(maps(folder), as_json)


@app.command("evaluate")
def evaluate_command(folder: Folder, as_json: JsonFlag = False) -> None:
    """How well the siblings and their merge foretell the twin."""
    answer(evaluation(folder), as_json)


@app.command("report")
def report_command(folder: Folder) -> None:
    """Write the report of a campaign again."""
    print(report(folder))
