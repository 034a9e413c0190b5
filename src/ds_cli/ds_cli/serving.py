# SPDX-License-Identifier: Apache-2.0
"""`ds serve donkey`: a simulator for clients of the Donkey simulator's protocol."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Annotated

import typer

from ds_base.installation import ds_command
from ds_cli import options
from ds_cli.output import say_next
from ds_sim.registry import SimulatorName

serve_app = typer.Typer()


@serve_app.command("donkey")
def serve_donkey_command(
    sim: options.Simulator = SimulatorName("donkey"),
    port: Annotated[int, typer.Option(min=0, max=65535, help="TCP port; 0 for any free one.")] = 9091,
    host: Annotated[
        str, typer.Option(help="Address to listen on. Clients are not authenticated: keep to this machine.")
    ] = "127.0.0.1",
    road: Annotated[
        Path | None, typer.Option(help="JSON list of roads, driven one after the other; a random one if left out.")
    ] = None,
    seed: options.Seed = 0,
    max_angle: options.MaxAngle = 270,
    lane: options.Lane = None,
    conditions: Annotated[
        str,
        typer.Option(help="Operating conditions, such as line_contrast=0.4.", autocompletion=options.complete_value),
    ] = "",
) -> None:
    """Serve a simulator to clients of the Donkey simulator, such as gym-donkeycar's environments.

    The simulator makes one frame for each control, as fast as the client sends them. The address is printed when
    clients can connect. Serves until it is stopped.

    Example: ds serve donkey --sim panda --port 9091
    """
    from ds_cli.roads import one_road, roads_of
    from ds_sim.conditions.text import parse_conditions
    from ds_sim.donkey_protocol.server import DonkeyServer
    from ds_sim.scenario import Scenario

    roads = [one_road(None, seed, max_angle, lane)] if road is None else roads_of(road, lane)
    chosen_conditions = parse_conditions(conditions)
    server = DonkeyServer(sim, [Scenario(one, chosen_conditions, seed=seed) for one in roads])

    def listening(chosen: int) -> None:
        print(f"serving {sim} on {host}:{chosen}", flush=True)
        say_next(ds_command("drive", "--sim", sim, "--driver", "autopilot"))

    asyncio.run(server.serve(host, port, listening))
