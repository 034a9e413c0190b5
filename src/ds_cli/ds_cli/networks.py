"""`ds collect`, `ds import`, `ds train`, `ds models`: driving networks, from data to success rates."""

from __future__ import annotations

import json
from collections.abc import Collection
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from ds_cli.options import (
    Camera,
    ImageRows,
    JsonFlag,
    RecordedSteering,
    Seed,
    Simulators,
    SteeringFactor,
    Trust,
    rows_of,
    simulators_of,
)
from ds_cli.output import Interrupted, Result, answer, countdown, say

if TYPE_CHECKING:
    from ds_driver.data.recordings import Reading

app = typer.Typer()


def collect(out: Path, simulators: list[str], **settings: Any) -> None:
    """Collect a data set; the settings are those of `ds_driver.data.collection.CollectionPlan`."""
    from ds_driver.data.collection import CollectionPlan
    from ds_driver.data.collection import collect as collect_drives
    from ds_driver.data.dataset import write_manifest
    from ds_sim.installation import versions

    plan = CollectionPlan(**settings)
    try:
        collect_drives(plan, simulators, out, countdown())
    except KeyboardInterrupt:
        raise Interrupted(_kept(out, "*.parquet", "drive")) from None
    write_manifest(out, {"plan": asdict(plan), "simulators": simulators, "versions": versions()})


def _kept(out: Path, pattern: str, what: str) -> str:
    """What a stopped verb leaves behind; empty if nothing."""
    count = len([file for file in out.rglob(pattern) if not file.name.startswith(".")]) if out.is_dir() else 0
    return f"{count} {what}{'' if count == 1 else 's'} in {out} are kept; the same command continues" if count else ""


def import_drives(folders: list[Path], out: Path, name: str, reading: Reading) -> Result:
    """Import recordings into a data set, as the drives of one more simulator."""
    from ds_driver.data.recordings import import_recordings, open_recording

    try:
        found = import_recordings([open_recording(folder, reading) for folder in folders], out, name, countdown())
    except KeyboardInterrupt:
        raise Interrupted from None

    def show() -> None:
        left = f"; {found.unlabelled} images without recorded steering are left out" if found.unlabelled else ""
        print(f"{found.images} images in {found.files} files are in {out / name}{left}")

    return Result(document=asdict(found), show=show)


def train(data: Path, out: Path, *, trusted: Collection[str] = (), **settings: Any) -> None:
    """Train a network; the settings are those of `ds_driver.training.TrainingPlan`."""
    from ds_driver.training import TrainingPlan
    from ds_driver.training import train as train_network

    plan = TrainingPlan(**settings)
    try:
        train_network(data, out, plan, say, trusted=trusted)
    except KeyboardInterrupt:
        raise Interrupted(_checkpoint(out)) from None
    print(out / f"{plan.network}.safetensors")


def _checkpoint(out: Path) -> str:
    """What a stopped training leaves behind; empty if nothing."""
    known = (out / "checkpoint.pt").is_file()
    return f"the finished epochs are kept in {out}; the same command continues" if known else ""


def models() -> Result:
    """The shipped networks with their model cards."""
    from ds_driver.networks.weights import load_weights, shipped_networks

    document = [
        {
            "name": name,
            "parameters": load_weights(name).architecture.parameters,
            "bytes": path.stat().st_size,
            "input": [160, 320, 3],
            "card": json.loads(path.with_suffix(".json").read_text()),
        }
        for name, path in shipped_networks().items()
    ]

    def show() -> None:
        table = Table("name", "parameters", "bytes", "success on unseen roads")
        for row in document:
            success = ", ".join(f"{k} {_mean(v):.2f}" for k, v in row["card"]["success"].items())
            table.add_row(row["name"], f"{row['parameters']:,}", f"{row['bytes']:,}", success)
        Console().print(table)

    return Result(document=document, show=show)


def _mean(rates: dict[str, float]) -> float:
    return sum(rates.values()) / len(rates)


@app.command("collect")
def collect_command(
    out: Annotated[Path, typer.Option(help="Folder of the data set; a collection that was stopped there is resumed.")],
    roads: Annotated[int, typer.Option(min=1, help="Random roads, each driven both ways.")] = 25,
    seed: Seed = 1,
    every: Annotated[int, typer.Option(min=1, help="Keep every Nth frame.")] = 1,
    disturbance: Annotated[float, typer.Option(min=0.0, max=1.0, help="Strength of random steering pushes.")] = 0.0,
    sims: Simulators = "bullet,softbody,panda,donkey",
) -> None:
    """Collect labelled driving data with the autopilot."""
    collect(out, simulators_of(sims), roads=roads, seed=seed, every=every, disturbance=disturbance)


@app.command("import")
def import_command(
    folders: Annotated[list[Path], typer.Argument(metavar="DIR...", help="Donkey Car tubs and bags with images.")],
    out: Annotated[Path, typer.Option(help="Folder of the data set, new or existing.")],
    name: Annotated[str, typer.Option(help="Name of the car, in the place of a simulator's.")] = "car",
    camera: Camera = None,
    steering: RecordedSteering = None,
    factor: SteeringFactor = 1.0,
    rows: ImageRows = None,
    trust: Trust = None,
    as_json: JsonFlag = False,
) -> None:
    """Import recorded drives of a real car into a data set.

    Networks can then be trained on it and compared.
    """
    from ds_driver.data.recordings import Reading

    reading = Reading(camera=camera, steering=steering, factor=factor, rows=rows_of(rows), trusted=tuple(trust or ()))
    answer(import_drives(folders, out, name, reading), as_json)


@app.command("train")
def train_command(
    data: Annotated[Path, typer.Option(help="Folder of a data set.")],
    out: Annotated[Path, typer.Option(help="Folder for the weights; a training that was stopped there is resumed.")],
    network: Annotated[str, typer.Option(help="Architecture: dave2, chauffeur or epoch.")] = "dave2",
    seed: Seed = 1,
    schedule: Annotated[str, typer.Option(help="Training schedule: laptop, or paper, which needs a GPU.")] = "laptop",
    epochs: Annotated[int | None, typer.Option(min=1, help="Epochs at most; the schedule's if left out.")] = None,
    images: Annotated[int | None, typer.Option(min=1, help="Images per simulator; all if left out.")] = None,
    learning_rate: Annotated[float, typer.Option(min=1e-7, max=1.0, help="Learning rate of Adam.")] = 1e-4,
    threads: Annotated[int, typer.Option(min=1, help="CPU threads.")] = 2,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda.")] = "auto",
    trust: Trust = None,
) -> None:
    """Train one network for all simulators of a data set."""
    from ds_driver.training import schedule_of

    chosen = schedule_of(schedule, network)
    train(
        data, out, network=network, seed=seed, epochs=chosen.epochs if epochs is None else epochs,
        patience=chosen.patience, without_dropout=chosen.without_dropout, images_per_simulator=images,
        learning_rate=learning_rate, threads=threads,
        device=device, trusted=trust or [],
    )  # fmt: skip


@app.command("models")
def models_command(as_json: JsonFlag = False) -> None:
    """List the shipped networks and their success rates."""
    answer(models(), as_json)
