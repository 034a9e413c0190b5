# SPDX-License-Identifier: Apache-2.0
"""`ds twin fit`: the twin's parameters from recorded drives."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from ds_base.installation import ds_command
from ds_cli.output import Result, ScreenProgress, say, verb
from ds_sim.conditions.text import format_3sf

MISFIT = 2.0
"""Residuals over noise above which the fit warns; chosen: the noise itself is known to some tens of a percent."""
twin_app = typer.Typer()


@verb(twin_app, "fit")
def twin_fit_command(
    logs: Annotated[
        list[Path], typer.Argument(metavar="LOG...", help="Bags, Donkey Car tubs and located recordings of drives.")
    ],
    out: Annotated[Path, typer.Option(help="Parameter file to write; fit.png goes beside it.")] = Path(
        "parameters.yaml"
    ),
    start: Annotated[
        Path | None,
        typer.Option(help="What to start from: parameters, myconfig.py, or a RoboRacer car's YAML or URDF."),
    ] = None,
) -> Result:
    """Fit the digital twin's parameters to recorded drives.

    `--sim donkey@FILE` then drives with them.

    Example: ds twin fit located --out car.yaml
    """
    from ds_report.fit_picture import draw_fit
    from ds_twin_donkey.car_files import read_start
    from ds_twin_donkey.fit import fit
    from ds_twin_donkey.located import fit_located
    from ds_twin_donkey.logs import read_log
    from ds_twin_donkey.parameter_file import document_of, write_parameters

    recorded = [read_log(path) for path in logs]
    initial = read_start(start) if start else None
    begin = initial.parameters if initial else None
    if initial and initial.taken:
        say(f"taken from {start}: {', '.join(initial.taken)}")
    drives = [drive for log in recorded for drive in log.drives]
    located = all(log.kind == "located" for log in recorded)
    mounting = None
    if located:
        fitted, mounting = fit_located(drives, begin, progress=ScreenProgress())
    else:
        fitted = fit(drives, begin, progress=ScreenProgress())
    for name, ratio in fitted.misfit.items():
        if ratio > MISFIT:
            say(
                f"warning: {name}: the residuals are {ratio:.1f} times the noise of the drives: "
                "the model does not follow them, and the intervals are too narrow"
            )
    document = document_of(fitted, recorded)
    if mounting is not None:
        document["poses"] = {"forward_m": round(mounting.forward, 4), "yaw_rad": round(mounting.yaw, 4)}
        say(
            f"the poses are {mounting.forward:.3f} m ahead of the car's centre, turned left by {mounting.yaw:.3f} rad: "
            "with a camera there, add that to forward_m in camera.yaml, and locate again"
        )
    write_parameters(out, document)
    picture = out.parent / "fit.png"
    draw_fit(fitted, picture)
    document |= {"file": str(out), "picture": str(picture)}

    def show() -> None:
        table = Table("parameter", "value", "95% interval", "unit", "")
        for name, row in document["parameters"].items():
            if row["status"] != "held":
                interval = " to ".join(format_3sf(value) for value in row.get("interval_95", []))
                table.add_row(name, format_3sf(row["value"]), interval, row["unit"], row["status"])
        Console().print(table)
        print(f"{out}\n{picture}")

    following = ds_command("drive", "--sim", f"donkey@{out}", "--driver", "autopilot")
    return Result(document=document, show=show, next=following)
