"""`ds runs`: the campaigns below a folder."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from ds_cli.options import JsonFlag
from ds_cli.output import Result, answer

app = typer.Typer()


def runs(folder: Path) -> Result:
    """List the campaigns below a folder.

    Raises:
        ds_orchestrator.campaign.config.ConfigError: there is no such folder.
    """
    from ds_bags.layout import printable
    from ds_orchestrator.campaign.config import ConfigError
    from ds_orchestrator.campaign.status import DEEPEST, campaigns_below

    if not folder.is_dir():
        raise ConfigError(f"{folder} is no folder: expected one with campaigns in it")
    rows = list(campaigns_below(folder))
    document = [{**asdict(row), "folder": str(row.folder), "failures": dict(row.failures)} for row in rows]

    def show() -> None:
        if not rows:
            print(f"no campaign in {folder}, nor in the {DEEPEST} levels of folders below it")
            return
        table = Table("campaign", "network", "digest", "last drive, UTC", "drives", "failures", "state")
        for row in rows:
            drives = f"{row.drives} of {row.drives_at_most}" if row.driver else ""
            failed = ", ".join(f"{name} {failures}/{tests}" for name, (failures, tests) in row.failures.items())
            when = row.changed.replace("T", " ")[:16]
            texts = (str(row.folder), row.driver, row.sha256[:8], when, drives, failed, row.state)
            table.add_row(*(Text(printable(text), overflow="fold") for text in texts))
        console = Console()
        if not console.is_terminal:
            console.width = max(console.width, 140)
        console.print(table)

    return Result(document=document, show=show)


@app.command("runs")
def runs_command(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder with campaigns.")] = Path("."),
    as_json: JsonFlag = False,
) -> None:
    """List the campaigns below a folder.

    Each with its network and digest, the time of its last drive, drives, failures, and whether it is done.
    """
    answer(runs(folder), as_json)
