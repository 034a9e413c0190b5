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

from ds_orchestrator.campaign.campaign_data import read_campaign
from ds_orchestrator.campaign.config import MOST_WORKERS, CampaignConfig, ConfigError, read_config
from ds_orchestrator.campaign.folder import config_of, open_store
from ds_orchestrator.campaign.runner import Stopped
from ds_orchestrator.cli.options import AttachFlag, Folder, JsonFlag, OutFolder, Trust
from ds_orchestrator.cli.output import Interrupted, Result, answer, end, say
from ds_orchestrator.cli.progress import ScreenListener
from ds_orchestrator.evaluation.campaign_evaluation import maps_of, network_of
from ds_orchestrator.evaluation.paper_tables import correlation_tables
from ds_orchestrator.search.features import feature_of
from ds_orchestrator.store.store import Store

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


def campaign(config: CampaignConfig, out: Path, *, attach: bool = False) -> Result:
    """Run a campaign to its report, or resume it.

    Raises:
        Interrupted: the user stopped it; what was finished is kept.
    """
    from ds_orchestrator.run import run_campaign

    started = time.monotonic()
    try:
        with ScreenListener() as listener:
            outcome = run_campaign(config, out, listener, attach=attach, say=say)
    except (KeyboardInterrupt, Stopped):
        raise Interrupted from None
    say(f"finished in {time.monotonic() - started:.0f} s")
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


def stored_config(folder: Path, trust: list[str] | None) -> CampaignConfig:
    """Read the configuration of a campaign folder; the code that it names is shipped or trusted."""
    from ds_orchestrator.run import check_trust

    with closing(open_store(folder)) as store:
        config = config_of(store)
    check_trust(config, trust or [])
    return config


def status(folder: Path) -> Result:
    """How far a campaign is, stage by stage."""
    with closing(open_store(folder)) as store:
        return _status(folder, store)


def _status(folder: Path, store: Store) -> Result:
    from ds_orchestrator.campaign.bag_groups import missing_bags, missing_line
    from ds_orchestrator.campaign.status import stages_of

    data = read_campaign(store)
    config, executions = data.config, data.executions
    counts: dict[str, dict[str, int]] = {name: {} for name in config.simulators}
    for execution in executions:
        counts[execution.simulator][execution.outcome.name] = (
            counts[execution.simulator].get(execution.outcome.name, 0) + 1
        )
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
        "missing_bags": missing,
        "errors": [
            dict(zip(("test_id", "simulator", "attempt", "outcome", "message"), row, strict=True))
            for row in data.errors
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
        if missing:
            print(missing_line(missing))
        if document["errors"]:
            print(f"{len(document['errors'])} attempts ended in an error; --json lists them")

    return Result(document=document, show=show)


def maps(folder: Path) -> Result:
    """Every map of a campaign."""
    from ds_orchestrator.maps.feature_map import to_json

    with closing(open_store(folder)) as store:
        document: dict[str, Any] = to_json(maps_of(read_campaign(store)))

    def show() -> None:
        for name, content in document.items():
            table = Table(title=name)
            features = [feature_of(name) for name in content["features"]]
            columns = [*(f.title for f in features), "tests", "failures", "probability", "95 %", "quality loss"]
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


def _with(config: CampaignConfig, workers: int | None) -> CampaignConfig:
    """The configuration with another number of workers."""
    return config if workers is None else config.model_copy(update={"workers": workers})


def shipped_config(name: str) -> CampaignConfig:
    """A configuration that comes with ds_bringup."""
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        path = Path(prefix) / "share" / "ds_bringup" / "config" / f"{name}.yaml"
        if path.exists():
            return read_config(path, hint=say)
    raise ConfigError(f"{name}.yaml of ds_bringup is not on AMENT_PREFIX_PATH: build and source the workspace")


@app.command("demo")
def demo_command(
    out: OutFolder = Path("demo"), workers: Workers = None, attach: AttachFlag = False, as_json: JsonFlag = False
) -> None:
    """The whole method, small, with the shipped network; ends with the path of the report."""
    end(campaign(_with(shipped_config("demo"), workers), out, attach=attach), as_json)


@campaign_app.command("run")
def campaign_run_command(
    config: Annotated[Path, typer.Argument(metavar="CONFIG.yaml", help="What to do.")],
    out: OutFolder,
    workers: Workers = None,
    attach: AttachFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Run a campaign, or go on with the one in the folder if it has the same configuration."""
    end(campaign(_with(read_config(config, hint=say), workers), out, attach=attach), as_json)


@campaign_app.command("resume")
def campaign_resume_command(
    folder: Folder,
    workers: Workers = None,
    attach: AttachFlag = False,
    trust: Trust = None,
    as_json: JsonFlag = False,
) -> None:
    """Go on with a campaign that was stopped."""
    end(campaign(_with(stored_config(folder, trust), workers), folder, attach=attach), as_json)


@campaign_app.command("status")
def campaign_status_command(folder: Folder, as_json: JsonFlag = False) -> None:
    """How far a campaign is."""
    answer(status(folder), as_json)


@app.command("maps")
def maps_command(folder: Folder, as_json: JsonFlag = False) -> None:
    """Every feature map of a campaign."""
    answer(maps(folder), as_json)


@app.command("report")
def report_command(folder: Folder, trust: Trust = None) -> None:
    """Write the report of a campaign again."""
    from ds_orchestrator.run import rebuild_report

    print(rebuild_report(folder, say=say, trusted=trust or []))
