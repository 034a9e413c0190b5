# SPDX-License-Identifier: Apache-2.0
"""`ds check`: what a network sees, and whether it is connected correctly, before anything is driven."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from ds_base.installation import ds_command
from ds_cli import options
from ds_cli.output import Result, ScreenProgress, say, verb

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
    from rich.console import Console
    from rich.table import Table

    from ds_base.errors import InputError
    from ds_base.folder_files import make_folder, write_whole
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
