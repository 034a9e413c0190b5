# SPDX-License-Identifier: Apache-2.0
"""`ds sensitivity`, `ds explain`: which conditions make a driver fail, and which parts of a simulator."""

from __future__ import annotations

import hashlib
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer
from rich.console import Console

from ds_base.folder_files import make_folder, write_json, write_whole
from ds_base.installation import ds_command
from ds_cli import options
from ds_cli.output import Result, ScreenProgress, say, stopped_in, verb
from ds_sim.conditions.model import ConditionsError
from ds_sim.registry import SimulatorName

app = typer.Typer()


@verb(app, "sensitivity")
def sensitivity_command(
    driver: options.DriverText = "dave2",
    backend: options.Backend = "auto",
    sims: options.Simulators = options.ALL,
    conditions: Annotated[
        str | None,
        typer.Option(
            help="Names of conditions, separated by commas; all of docs/conditions.md if left out.",
            autocompletion=options.complete_condition,
        ),
    ] = None,
    roads: Annotated[
        int, typer.Option(min=1, max=100, help="Short roads on each simulator that the driver completes by default.")
    ] = 3,
    levels: Annotated[
        int, typer.Option(help="Levels of strength that may be driven up to the hardest value: 2, 4, 8 or 16.")
    ] = 8,
    segments: Annotated[
        int, typer.Option(min=2, max=6, help="Length of the roads in segments of 25 m; 6 are the roads of a campaign.")
    ] = 4,
    seed: options.Seed = 1,
    out: Annotated[
        Path | None, typer.Option(help="Folder for tables, picture and drives; a stopped analysis is resumed.")
    ] = None,
    *,
    driving: options.DrivingAnywhere,
) -> Result:
    """Find how strong each operating condition must be for a driver to fail.

    Each condition, such as fog or worn lines, becomes stronger by bisection until the driver fails on the median road.
    It goes only as far as the autopilot completes the same test. A condition that a simulator does not support is not
    applicable.

    Example: ds sensitivity --driver my_net.yaml --out sensitivity
    """
    from ds_analysis.sensitivity import RESOLUTIONS, all_factors, factors_named
    from ds_base.table import write_tables
    from ds_orchestrator.campaign.engine import DriveSettings
    from ds_report.sensitivity_page import SensitivityPage, draw_sensitivity
    from ds_sim.camera.encodings import png
    from ds_studies.sensitivity import analyse_sensitivity

    network = options.driver_named(driver, backend)
    names = options.every_or_named(sims)
    if levels not in RESOLUTIONS:
        raise ConditionsError(f"--levels {levels} is not possible: expected {', '.join(map(str, RESOLUTIONS))}")
    factors = all_factors() if conditions is None else factors_named([c.strip() for c in conditions.split(",")])
    settings = DriveSettings(siblings=tuple(names), driver=network, **driving.without_ros())
    folder = page = None
    if out is not None:
        make_folder(out)
        folder, page = out / "drives", SensitivityPage(out / "sensitivity.html")
        say(f"live in a browser: {page.path}")
    with stopped_in(folder):
        result = analyse_sensitivity(
            settings,
            factors,
            roads=roads,
            levels=levels,
            segments=segments,
            seed=seed,
            folder=folder,
            progress=ScreenProgress(),
            watch=page.write if page else lambda result: None,
        )
    document = {"seed": seed, "segments": segments, "levels": levels, **result.document()}
    if out is not None:
        write_json(out / "sensitivity.json", document)
        write_tables([result.table(), result.long_table()], out)
        write_whole(out / "sensitivity.png", png(draw_sensitivity(result, out / "sensitivity")))

    def show() -> None:
        result.table().show(Console())
        for line in result.errors:
            print(f"error: {line}")
        if page is not None:
            print(page.path)

    following = ds_command("test", network, *(("--sensitivity", out) if out else ()))
    return Result(document=document, show=show, error=bool(result.errors), next=following)


@verb(app, "explain")
def explain_command(
    folder: options.Folder,
    test: Annotated[
        str | None, typer.Option(help="Test that fails; one of each of the largest groups of failures if left out.")
    ] = None,
    sim: Annotated[SimulatorName | None, options.simulator_option("With --test: simulator on which it fails.")] = None,
    against: Annotated[
        SimulatorName | None, options.simulator_option("With --test: simulator on which it completes.")
    ] = None,
    groups: Annotated[
        int, typer.Option(min=0, max=20, help="Largest groups of failures to explain; 0 only lists all groups.")
    ] = 3,
    out: Annotated[
        Path | None, typer.Option(help="Folder for tables and drives; a stopped experiment is resumed.")
    ] = None,
    *,
    driving: options.DrivingAnywhere,
    trust: options.Trust = None,
) -> Result:
    """Find out why tests of a campaign fail.

    The record of a test shows how the car left its lane, and what led there. If another simulator
    completes the test, an experiment exchanges camera, look, vehicle, delays and conditions between the two, in all
    combinations, and drives again. Each part then gets its share of the failure.

    Example: ds explain out
    """
    from ds_analysis.failures import groups_of, groups_table, reason_of, reasons_of, where
    from ds_base.table import write_tables
    from ds_cli.progress import ScreenListener
    from ds_orchestrator.campaign.config import ConfigError
    from ds_orchestrator.campaign.folder import read_folder
    from ds_orchestrator.engines.drive_tests import Callbacks
    from ds_studies.explanation import drive_experiments, experiment_on, experiments_on
    from ds_studies.whole_campaign import check_trust

    if test is None and (sim is not None or against is not None):
        raise ConfigError("--sim and --against choose the simulators of one test: give --test, too")
    if driving.engine == "graph":
        raise ConfigError("--engine graph would start a node for every exchange: expected local or dask")
    data = read_folder(folder)
    if test is not None or groups:  # something is driven, and so made
        check_trust(data.config, trust or ())
    failure_groups = groups_of(reasons_of(data))
    experiments = (
        experiments_on(data, failure_groups, groups) if test is None else [experiment_on(data, test, sim, against)]
    )
    failed = {(e.test_id, e.simulator): e for e in data.executions}
    reasons = [reason_of(one.test, failed[one.test.test_id, one.fails]) for one in experiments]
    driving = replace(driving, engine="local") if driving.engine == "auto" else driving
    settings = replace(data.config.drive_settings(), driver=data.driver, **driving.without_ros())
    with nullcontext(out) if out is not None else TemporaryDirectory(prefix="ds_explain_") as place:
        # A folder of drives belongs to its simulators, so that other experiments need another one.
        pairs = sorted(f"{one.test.test_id}-{one.fails}-{one.against}" for one in experiments)
        drives = Path(place) / "drives" / hashlib.sha256(" ".join(pairs).encode()).hexdigest()[:12]
        callbacks = Callbacks(listen=ScreenListener)
        with stopped_in(drives if out is not None else None):
            driven = drive_experiments(experiments, settings, drives, callbacks)
    explained = [one.explained(driven) for one in experiments]
    tables = [*([groups_table(failure_groups)] if test is None else []), *(one.table() for one in explained)]
    document = {
        "groups": [{"kind": kind, "failures": len(of), "where": where(of)} for kind, of in failure_groups.items()],
        "tests": [{"reason": why._asdict(), **one.document()} for why, one in zip(reasons, explained, strict=True)],
    }
    if out is not None:
        make_folder(out)
        write_json(out / "explanation.json", document)
        write_tables(tables, out)

    def show() -> None:
        console = Console()
        if test is None:
            tables[0].show(console)
        for why, one in zip(reasons, explained, strict=True):
            print(f"\nOn {one.fails} the driver {why.kind} ({why.details}).\n{one.sentence}")
            if one.repeats:
                one.table().show(console)
        if groups and not experiments:
            print("No failed test is completed by another simulator, so there is nothing to exchange.")
        if out is not None:
            print(out)

    following = ds_command("campaign", "roads", folder, "--failed", "--out", "failures.json")
    error = not all(one.repeats for one in explained)
    return Result(document=document, show=show, error=error, next=following)
