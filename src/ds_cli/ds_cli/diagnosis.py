# SPDX-License-Identifier: Apache-2.0
"""`ds check`, `ds sensitivity`, `ds explain`: how a network is connected, which conditions it fails under, and why."""

from __future__ import annotations

import hashlib
import sys
import time
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


@verb(app, "check")
def check_command(
    network: Annotated[
        str,
        typer.Argument(
            metavar="NETWORK",
            help="Network: a .yaml file, an .onnx, .pt or .tflite file without one, a shipped name, or module:Class.",
        ),
    ],
    sims: options.Simulators = options.ALL,
    out: Annotated[Path, typer.Option(help="Folder for the picture, check.png.")] = Path("check"),
    seed: options.Seed = 1,
    seconds: Annotated[
        float, typer.Option("--time", min=1.0, help="Seconds for the whole check; a slow network gets fewer images.")
    ] = 120.0,
) -> Result:
    """Show what a network sees, and say what is wrong with how it is connected.

    The autopilot drives, and the network answers the images without driving. Its answers tell how the file wants its
    images and what its outputs mean. If the file has no description, one is written next to it.

    Exit status: 0 nothing wrong found, 2 bad input, 3 not connected correctly, or trained on another world.

    Example: ds check my_net.onnx
    """
    from rich.table import Table

    from ds_base.errors import InputError
    from ds_driver.networks.described_network import DescribedNetworkPilot
    from ds_driver.networks.network_driver import load_pilot
    from ds_driver.networks.network_file import KINDS
    from ds_sim.camera.encodings import png
    from ds_studies.network_check.description import describe_network, forms_of, load
    from ds_studies.network_check.diagnosis import ASKED, check_network, pace_of
    from ds_studies.network_check.picture import draw_check
    from ds_studies.network_check.recording import affordable, record

    began = time.monotonic()
    names, file = options.every_or_named(sims), Path(network)
    bare = file.suffix.lower() in KINDS
    forms = forms_of(file) if bare else []
    # Refuses what cannot be used before anything is driven.
    loaded = load(file, forms) if bare else None
    pilot = loaded or load_pilot(options.driver_named(network))
    make_folder(out)
    recordings = record(names, seed, ScreenProgress(), whole=pilot.has_memory)
    pace = pace_of(pilot, recordings[0].frames[0])
    asked = ASKED["file" if bare else "description" if isinstance(pilot, DescribedNetworkPilot) else "other"]
    left = max(seconds - (time.monotonic() - began), seconds / 4)
    recordings, search = affordable(recordings, pace, left, asked=asked, whole=pilot.has_memory)
    if not search:
        say(f"{network} takes {pace:.2g} s for an image: no other description is tried in {seconds:g} s (--time)")
    if bare:
        network = str(file.with_suffix(".yaml"))
        say(f"choosing a description for {file}")
        text = describe_network(
            file, forms, recordings, _ask if sys.stdin.isatty() else None, search=search, loaded=loaded
        )
        if Path(network).exists():
            raise InputError(f"{network} exists meanwhile: move it away, and check {file} again")
        write_whole(Path(network), text)
        say(f"wrote {network}: its comments say what was chosen, and why")
    say(f"asking {network} about {sum(len(one.frames) for one in recordings)} images")
    check = check_network(options.driver_named(network), recordings, seed, search=search, loaded=loaded)
    picture = out / "check.png"
    write_whole(picture, png(draw_check(check, recordings)))

    def show() -> None:
        table = Table(title=f"{network} against the autopilot on {check.images} images")
        for column in ("simulator", "correlation", "slope", "answers", "at full lock", "ms an image"):
            table.add_column(column, justify="left" if column == "simulator" else "right")
        for one in check.answers:
            table.add_row(
                one.simulator,
                f"{one.correlation:.2f}",
                f"{one.slope:.2g}",
                f"{one.lowest:.2g} to {one.highest:.2g}",
                f"{one.at_full_lock:.0%}",
                f"{one.milliseconds:.1f}",
            )
        Console().print(table)
        print(check.verdict)
        for finding in check.findings:
            print(finding)
        print(picture)

    document = {**check.document(), "picture": str(picture)}
    unmet = [] if not check.findings else [f"{network} needs another description or training"]
    following = ds_command("check" if unmet else "test", network)
    return Result(document=document, show=show, unmet=unmet, next=following)


def _ask(question: str, choices: list[str], best: str) -> str:
    return str(typer.prompt(f"{question} ({', '.join(choices)})", best, err=True))


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
