"""Options that several verbs of `ds` share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ds_driver.closed_loop.simulation import AUTOPILOT
from ds_sim.registry import UnknownSimulatorError, make_simulator

JsonFlag = Annotated[bool, typer.Option("--json", help="One JSON document on standard output.")]
OutFolder = Annotated[Path, typer.Option(help="Folder of the campaign; one that was stopped there goes on.")]
AttachFlag = Annotated[bool, typer.Option(help="Start nothing: use the nodes that run in this ROS domain.")]
Folder = Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a campaign.")]
Seed = Annotated[int, typer.Option(min=0, help="Seed of the random road.")]
MaxAngle = Annotated[int, typer.Option(min=1, max=360, help="Maximum angle of random roads, degrees.")]
Simulators = Annotated[str, typer.Option(help="Simulators, separated by commas.")]

DriverName = Annotated[str, typer.Option(help="autopilot, dave2, a .safetensors or .yaml file, or module:Class.")]
Backend = Annotated[str, typer.Option(help="What computes the network: auto, torch, onnx or openvino.")]
Device = Annotated[str, typer.Option(help="cpu, or cuda for PyTorch on a GPU.")]

Camera = Annotated[str | None, typer.Option(help="Topic of the images, if there are several.")]
RecordedSteering = Annotated[
    str | None, typer.Option(help="TOPIC:FIELD of the recorded steering, such as /cmd:drive.steering_angle.")
]
SteeringFactor = Annotated[float, typer.Option(help="Makes of that -1 full left to +1 full right.")]
ImageRows = Annotated[str | None, typer.Option(help="FIRST:LAST image rows to keep; the lower part if left out.")]

Trust = Annotated[
    list[str] | None,
    typer.Option(
        "--trust",
        metavar="NAME",
        help="Simulator or driver named in the folder that may run code of its own, such as module:Class; repeatable.",
    ),
]


def rows_of(text: str | None) -> tuple[int, int] | None:
    """`FIRST:LAST` as two numbers."""
    if text is None:
        return None
    first, colon, last = text.partition(":")
    if colon and first.isdigit() and last.isdigit():
        return int(first), int(last)
    raise typer.BadParameter(f"{text!r}: expected FIRST:LAST, such as 40:120")


def simulators_of(text: str) -> list[str]:
    """Simulators by name, separated by commas; each can be made, and none is named twice."""
    names = text.split(",")
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise UnknownSimulatorError(f"simulator {', '.join(twice)} is named twice in {text!r}: name each once")
    for name in names:
        make_simulator(name).close()
    return names


def driver_named(driver: str, backend: str, device: str) -> str:
    """A driver's name with what computes it, as `dave2@onnx`; the autopilot computes no network.

    Raises:
        ds_driver.networks.backends.BackendError: backend or device are unknown, or do not go together.
    """
    from ds_driver.networks.backends import BackendError, with_backend

    named = with_backend(driver, backend, device)
    if driver == AUTOPILOT and named != driver:
        raise BackendError("the autopilot computes no network: leave out --backend and --device")
    return named
