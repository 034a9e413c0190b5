"""`ds twin fit`: the twin's parameters from recorded drives."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from ds_orchestrator.cli.options import JsonFlag
from ds_orchestrator.cli.output import Interrupted, Result, answer, say

MISFIT = 2.0
"""Residuals over noise above which the fit says so; chosen: the noise itself is known to some tens of a percent."""
app = typer.Typer()
twin_app = typer.Typer(help="The digital twin: fit it to recorded drives.", no_args_is_help=True)
app.add_typer(twin_app, name="twin")


def fit_twin(paths: list[Path], out: Path, start: Path | None, *, window: float, evaluations: int) -> Result:
    """Fit the twin to recorded drives; writes the file of parameters and, beside it, `fit.png`."""
    from ds_twin_donkey.fit import FitSettings, fit
    from ds_twin_donkey.fit_picture import draw_fit
    from ds_twin_donkey.logs import read_log
    from ds_twin_donkey.parameter_file import document_of, read_parameters, write_parameters

    logs = [read_log(path) for path in paths]
    begin = read_parameters(start)[0] if start else None
    out.parent.mkdir(parents=True, exist_ok=True)
    drives = [drive for log in logs for drive in log.drives]
    try:
        found = fit(drives, begin, FitSettings(window_seconds=window, max_evaluations=evaluations), say)
    except KeyboardInterrupt:
        raise Interrupted from None
    for name, ratio in found.misfit.items():
        if ratio > MISFIT:
            say(
                f"{name}: what is left over is {ratio:.1f} times the noise of the drives: "
                "the model does not follow them, and the intervals are too narrow"
            )
    document = document_of(found, logs)
    write_parameters(out, document)
    picture = out.parent / "fit.png"
    draw_fit(found, picture)
    document |= {"file": str(out), "picture": str(picture)}

    def show() -> None:
        table = Table("parameter", "value", "95 % interval", "unit", "")
        for name, row in document["parameters"].items():
            if row["status"] != "held":
                interval = " to ".join(f"{value:.4g}" for value in row.get("interval_95", []))
                table.add_row(name, f"{row['value']:.4g}", interval, row["unit"], row["status"])
        Console().print(table)
        print(out)

    return Result(document=document, show=show)


@twin_app.command("fit")
def twin_fit_command(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="Bags and Donkey Car tubs.")],
    out: Annotated[Path, typer.Option(help="File of parameters to write; fit.png goes beside it.")] = Path(
        "parameters.yaml"
    ),
    start: Annotated[Path | None, typer.Option(help="File of parameters to begin with; nominal if left out.")] = None,
    window: Annotated[float, typer.Option(min=1.0, max=30.0, help="Length of a window, s.")] = 10.0,
    evaluations: Annotated[int, typer.Option(min=1, help="At most, per round.")] = 40,
    as_json: JsonFlag = False,
) -> None:
    """Fit the twin's parameters to recorded drives."""
    answer(fit_twin(logs, out, start, window=window, evaluations=evaluations), as_json)
