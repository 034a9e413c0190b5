# SPDX-License-Identifier: Apache-2.0
"""`ds sensitivity`: the strength at which operating conditions make a driver fail."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ds_base.installation import ds_command
from ds_cli import options
from ds_cli.output import Result, ScreenProgress, say, stopped_in, verb
from ds_sim.conditions.model import ConditionsError

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
    from rich.console import Console

    from ds_analysis.sensitivity import RESOLUTIONS, all_factors, factors_named
    from ds_base.atomic_files import write_json, write_whole
    from ds_base.folder_files import make_folder
    from ds_base.table import write_tables
    from ds_orchestrator.campaign.engine import DriveSettings
    from ds_report.sensitivity_page import SensitivityPage, draw_sensitivity
    from ds_sim.camera.encodings import png
    from ds_studies.sensitivity.analysis import analyse_sensitivity

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
