# SPDX-License-Identifier: Apache-2.0
"""`ds campaign status, roads, export`, `ds report`, `ds watch`: what a campaign has done so far."""

from __future__ import annotations

import json
from collections import Counter
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from ds_base.installation import ds_command
from ds_base.words import count
from ds_cli import options
from ds_cli.campaign.run import campaign_app
from ds_cli.output import Result, printed_to, say, say_next, verb, warning
from ds_sim.registry import SimulatorName

app = typer.Typer()


@verb(campaign_app, "status")
def campaign_status_command(folder: options.Folder) -> Result:
    """Show how far a campaign is, stage by stage.

    Example: ds campaign status out
    """
    from ds_analysis.paper.campaign_contents import exclusion_counts, exclusion_lines
    from ds_orchestrator.campaign.folder import CampaignData, config_of, open_store
    from ds_orchestrator.campaign.status import driver_habits, missing_bags, stages_of_store

    with closing(open_store(folder)) as store:
        data = CampaignData(config=config_of(store), gates=store.gates())
        stages = stages_of_store(store, data.config)
        counted, searches, errors = store.drive_counts(), store.searches(), store.errors()
        missing = missing_bags(folder, store.bags())
        habits = driver_habits(store)
    config, executions = data.config, sum(row.executions for row in counted)
    counts: dict[str, Counter[str]] = {name: Counter() for name in config.simulators}
    for row in counted:
        counts[row.simulator][row.outcome] += row.executions
    driving = [stage.expected for stage in stages if stage.failures is not None]
    drives = sum(n for n in driving if n is not None) if None not in driving else config.executions_at_most
    document: dict[str, Any] = {
        "executions": executions,
        "executions_in_all": drives,
        "stages": [{**asdict(stage), "state": stage.state} for stage in stages],
        "searches": [row._asdict() for row in searches],
        "outcomes": counts,
        "excluded": exclusion_counts(data),
        "missing_bags": missing,
        "warnings": [habit.text for habit in habits],
        "errors": [row._asdict() for row in errors],
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
            are_missing = count(len(missing), "recorded bag is missing", "recorded bags are missing")
            print(f"{are_missing}, {missing[0]} the first")
        for habit in habits:
            print(warning(str(config.driver), habit))
        if document["errors"]:
            print(f"{len(document['errors'])} attempts ended in an error; --json lists them")

    done = all(stage.state == "done" for stage in stages)
    following = ds_command("report", folder) if done else ds_command("campaign", "resume", folder)
    return Result(document=document, show=show, next=following)


@campaign_app.command("roads")
def campaign_roads_command(
    folder: options.Folder,
    failed: Annotated[bool, typer.Option("--failed", help="Only roads on which the driver failed.")] = False,
    simulator: Annotated[
        SimulatorName | None,
        options.simulator_option("Only roads driven on this simulator; --failed then means failed there."),
    ] = None,
    cell: Annotated[
        str | None, typer.Option(help="Only roads of this cell of the feature map, as on its axes, such as 3,0.17.")
    ] = None,
    test: Annotated[str | None, typer.Option(help="Only the road of this test.")] = None,
    out: Annotated[Path | None, typer.Option(help="File to write; standard output if left out.")] = None,
) -> None:
    """Print a campaign's roads as JSON, as `ds drive --road` and `ds road check` take it.

    Each road comes with its test, seed, cell, and outcome on every simulator. If a file holds one road, `ds drive
    --road FILE` drives it with the seed of its test, which repeats the recorded run.

    Example: ds campaign roads out --failed --out failures.json
    """
    from ds_base.folder_files import write_whole
    from ds_orchestrator.campaign.status import roads_of

    roads = roads_of(folder, failed=failed, simulator=simulator, cell=cell, test=test)
    # One road per line, so that a line can be cut out and driven.
    text = "[\n" + ",\n".join(json.dumps(road, allow_nan=False) for road in roads) + "\n]" if roads else "[]"
    if out is None:
        print(text)
    else:
        write_whole(out, text + "\n")
        print(out)
    say(count(len(roads), "road"))
    kept = out or printed_to()
    say_next(ds_command("report", folder) if kept is None else ds_command("road", "check", kept))


@app.command("report")
def report_command(folder: options.Folder, trust: options.Trust = None) -> None:
    """Rebuild the report of a campaign, or write one of imported outcomes.

    The maps and tables of a campaign are computed again, too. Nothing is driven.

    Example: ds report out
    """
    from ds_analysis.common.outcome_table import is_study
    from ds_cli.progress import StageLines
    from ds_studies.whole_campaign import rebuild_report

    if is_study(folder):
        from ds_analysis.outcomes.study import read_study
        from ds_report.study_page import write_study_page

        print(write_study_page(folder, read_study(folder)))
    else:
        print(rebuild_report(folder, StageLines(), trusted=trust or []))
    say_next(ds_command("predict", folder))


@campaign_app.command("export")
def campaign_export_command(
    folder: options.Folder,
    out: Annotated[Path, typer.Option(help="Folder to write to, created if missing.")],
    frames: Annotated[bool, typer.Option("--frames", help="Also write every frame of every drive.")] = False,
) -> None:
    """Write a campaign's outcomes as a study: a Parquet table for pandas, Polars, DuckDB or Spark, and for `ds`.

    outcomes.parquet has a row for each drive; with --frames, frames.parquet one for each frame, with units and meanings
    of the columns. The campaign may still be running.

    Example: ds campaign export out --out study
    """
    from ds_analysis.common.outcome_table import table_of_campaign
    from ds_analysis.outcomes.frames import write_frames
    from ds_analysis.outcomes.study import study_of, write_study
    from ds_orchestrator.campaign.folder import read_folder

    data = read_folder(folder)
    print(write_study(out, study_of(table_of_campaign(data))))
    if frames:
        print(write_frames(out, data))
    say_next(ds_command("maps", out))


@app.command("watch")
def watch_command(
    folder: options.Folder,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port of this machine's loopback interface; 0 for any free one.")
    ] = 8760,
    trust: options.Trust = None,
) -> None:
    """Show a campaign in the browser while it runs.

    The page shows progress, time left, the latest drives and the feature maps. Only this machine can open it, and it
    changes nothing in the folder.

    Example: ds watch out
    """
    import asyncio

    from ds_report.watch.server import serve

    def ready(address: str) -> None:
        print(address, flush=True)
        say(f"shows {folder}, until Ctrl-C")
        say_next(ds_command("report", folder))

    asyncio.run(serve(folder, port=port, trusted=trust or (), ready=ready))
