"""`ds bag`: what is in a bag, and what can be done with it."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from ds_orchestrator.commands.answers import Result, answer
from ds_orchestrator.commands.options import JsonFlag

app = typer.Typer()
bag_app = typer.Typer(help="Recorded runs: look into them, replay them, drive them again.", no_args_is_help=True)
app.add_typer(bag_app, name="bag")

BagFolder = Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a bag.")]


def bag_info(folder: Path) -> Result:
    """What is in a bag."""
    from ds_orchestrator.bag_info import in_words, info

    document = info(folder)

    def show() -> None:
        for line in in_words(document):
            print(line)
        table = Table("topic", "type", "messages")
        for topic in document["topics"]:
            table.add_row(topic["name"], topic["type"], str(topic["messages"]))
        Console().print(table)

    return Result(document=document, show=show)


def bag_recover(folder: Path, out: Path | None) -> Result:
    """Make a bag of what a killed writer left."""
    from ds_orchestrator.recovering import recover

    found = recover(folder, out)
    document = {key: str(value) if isinstance(value, Path) else value for key, value in asdict(found).items()}

    def show() -> None:
        print(
            f"{found.folder}: {found.messages} messages over {found.seconds:.2f} s; the last {found.lost_bytes} bytes "
            f"of {found.source} were of no use. The remains are still there."
        )

    return Result(document=document, show=show)


@bag_app.command("info")
def info_command(folder: BagFolder, as_json: JsonFlag = False) -> None:
    """Say what is in a bag: ours or anybody's."""
    answer(bag_info(folder), as_json)


@bag_app.command("recover")
def recover_command(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Where the bag should be, or what there is of it.")],
    out: Annotated[Path | None, typer.Option(help="Folder to make; DIR_recovered if left out.")] = None,
    as_json: JsonFlag = False,
) -> None:
    """Make a whole bag of one whose writer was killed."""
    answer(bag_recover(folder, out), as_json)
