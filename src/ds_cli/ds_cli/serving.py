"""`ds serve donkey`: a simulator for clients of the Donkey simulator's protocol."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ds_cli.options import Lane, MaxAngle, Seed, Simulator
from ds_cli.output import Interrupted, say

if TYPE_CHECKING:
    from ds_road import Road, Side
    from ds_sim.donkey_protocol.conversation import ServedTests

app = typer.Typer()
serve_app = typer.Typer(help="Serve a simulator to clients of another one's protocol.", no_args_is_help=True)
app.add_typer(serve_app, name="serve")


@serve_app.command("donkey")
def serve_donkey_command(
    sim: Simulator = "donkey",
    port: Annotated[int, typer.Option(min=0, max=65535, help="TCP port; 0 for any free one.")] = 9091,
    host: Annotated[
        str, typer.Option(help="Address to listen on. Clients are not authenticated: keep to this machine.")
    ] = "127.0.0.1",
    road: Annotated[
        Path | None,
        typer.Option(help="JSON list of roads, driven one after the other; a random one if left out."),
    ] = None,
    seed: Seed = 0,
    max_angle: MaxAngle = 270,
    lane: Lane = None,
    conditions: Annotated[str, typer.Option(help="Operating conditions, such as line_contrast=0.4.")] = "",
    clients: Annotated[int, typer.Option(min=1, max=64, help="Clients connected at the same time.")] = 8,
    timeout: Annotated[
        float, typer.Option(min=1.0, max=86400.0, help="Disconnect a client that is silent for this many seconds.")
    ] = 600.0,
) -> None:
    """Serve a simulator to clients of the Donkey simulator, such as gym-donkeycar's environments.

    Lock-step: the simulator makes one frame for each control, as fast as the client sends them. Prints the address when
    clients can connect, and serves until it is stopped.
    """
    from ds_sim.conditions.text import parse_conditions
    from ds_sim.donkey_protocol.conversation import ServedTests

    tests = ServedTests(
        roads=roads_to_serve(road, seed, max_angle, lane), seed=seed, conditions=parse_conditions(conditions)
    )
    serve_donkey(sim, tests, host=host, port=port, clients=clients, timeout=timeout)


def roads_to_serve(file: Path | None, seed: int, max_angle: int, lane: Side | None) -> list[Road]:
    """The roads of a file, or a random one.

    Raises:
        ds_road.RoadError: the file holds none, or one that cannot be driven.
    """
    import ds_road
    from ds_cli.roads import one_road

    if file is None:
        return [one_road(None, seed, max_angle, lane)]
    roads = [road if lane is None else road.in_lane(lane) for road in ds_road.read_roads(file)]
    if not roads:
        raise ds_road.RoadError(f"{file}: no road, expected at least one")
    for index, road in enumerate(roads):
        if not road.validity.valid:
            raise ds_road.RoadError(f"{file}: road {index} cannot be driven: {road.validity.reason}")
    return roads


def serve_donkey(sim: str, tests: ServedTests, *, host: str, port: int, clients: int, timeout: float) -> None:
    """Serve until the user stops it.

    Raises:
        ds_sim.donkey_protocol.server.ServerError: the address cannot be used.
        Interrupted: the user stopped it.
    """
    from ds_sim.donkey_protocol.server import DonkeyServer

    server = DonkeyServer(sim, tests, patience=timeout, most_clients=clients, report=say)

    def listening(chosen: int) -> None:
        print(f"serving {sim} on {host}:{chosen}", flush=True)

    try:
        asyncio.run(server.serve(host, port, listening))
    except KeyboardInterrupt:
        raise Interrupted from None
