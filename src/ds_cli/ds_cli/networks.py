# SPDX-License-Identifier: Apache-2.0
"""`ds collect`, `import`, `train`, `models`, `sim2real`: driving networks and generators, from data to weights."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console
from rich.table import Table

from ds_base.bounded_file import read_json
from ds_base.installation import ds_command, versions
from ds_base.words import count
from ds_cli import options
from ds_cli.output import Result, ScreenProgress, say, say_next, stopped, verb
from ds_sim.registry import SimulatorName

app = typer.Typer()


@app.command("collect")
def collect_command(
    out: Annotated[Path, typer.Option(help="Folder of the data set; a collection that was stopped there is resumed.")],
    roads: Annotated[
        int | None, typer.Option(min=1, help="Random roads, each driven both ways; 25 if left out.")
    ] = None,
    road: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Drive these roads instead, as from `ds campaign roads --failed`, under their tests' conditions.",
        ),
    ] = None,
    mutants: Annotated[int, typer.Option(min=0, max=100, help="With --road: mutants of each road.")] = 0,
    seed: options.Seed = 1,
    every: Annotated[int, typer.Option(min=1, help="Keep every Nth frame.")] = 1,
    disturbance: Annotated[float, typer.Option(min=0.0, max=1.0, help="Strength of random steering pushes.")] = 0.0,
    sims: options.Simulators = options.ALL,
) -> None:
    """Collect labelled driving data with the autopilot.

    Example: ds collect --out data --roads 25
    """
    from ds_driver.data.collection import CollectionPlan, collect, given_roads
    from ds_driver.data.dataset import DatasetError, write_manifest

    simulators = options.every_or_named(sims)
    if (road is None and mutants) or (road is not None and roads is not None):
        raise DatasetError("expected either --roads for random roads, or --road FILE and perhaps --mutants")
    roads_to_drive = None if road is None else given_roads(road, mutants=mutants, seed=seed)
    number = (roads or 25) if roads_to_drive is None else len(roads_to_drive)
    plan = CollectionPlan(roads=number, seed=seed, every=every, disturbance=disturbance)

    def kept() -> str:
        files = [file for file in out.rglob("*.parquet") if not file.name.startswith(".")] if out.is_dir() else []
        return f"{count(len(files), 'drive')} in {out} are kept; the same command continues" if files else ""

    with stopped(kept):
        collect(plan, simulators, out, ScreenProgress(), roads_to_drive)
    write_manifest(out, {"plan": asdict(plan), "simulators": simulators, "versions": versions()})
    counts = read_json(out / "manifest.json")["images"]
    print(f"{sum(counts.values())} images of {', '.join(simulators)} are in {out}")
    say_next(_training_of(out))


@verb(app, "import")
def import_command(
    folders: Annotated[list[Path], typer.Argument(metavar="DIR...", help="Donkey Car tubs and bags with images.")],
    out: Annotated[Path, typer.Option(help="Folder of the data set, new or existing.")],
    name: Annotated[str, typer.Option(help="Name of the car, in the place of a simulator's.")] = "car",
    camera: options.ImageTopic = None,
    steering: options.RecordedSteering = None,
    factor: options.SteeringFactor = 1.0,
    rows: options.ImageRows = None,
    trust: options.Trust = None,
    strict: Annotated[
        bool, typer.Option("--strict", help="Refuse a recording with an image that cannot be read.")
    ] = False,
) -> Result:
    """Import recorded drives of a real car into a data set.

    `ds train` can then train on it, and `ds evaluate` can compare networks on it.

    Example: ds import my_tub --out data
    """
    from ds_base.left_out import LeftOut
    from ds_driver.data.recordings import Reading, import_recordings, open_recording

    reading = Reading(
        camera=camera, steering=steering, factor=factor, rows=options.rows_of(rows), trusted=tuple(trust or ())
    )
    left_out = LeftOut("images", strict)
    recordings = [open_recording(folder, reading) for folder in folders]
    imported = import_recordings(recordings, out, name, ScreenProgress(), left_out)

    def show() -> None:
        left = f"; {imported.unlabelled} images without recorded steering are left out" if imported.unlabelled else ""
        print(f"{imported.images} images in {imported.files} files are in {out / name}{left}")

    if left_out.items:
        say(left_out.line())
    document = asdict(imported) | {"unreadable": len(left_out.items)}
    return Result(document=document, show=show, next=_training_of(out))


@app.command("train")
def train_command(
    data: Annotated[list[Path], typer.Option(help="Folder of a data set; repeat it to train on several.")],
    out: Annotated[Path, typer.Option(help="Folder for the weights; a training that was stopped there is resumed.")],
    network: Annotated[
        str | None, typer.Option(help="Architecture: dave2, chauffeur or epoch; as in --from, or dave2, if left out.")
    ] = None,
    start: Annotated[
        str | None,
        typer.Option(
            "--from", metavar="NET", help="Continue from a shipped network or a .safetensors file: fine-tuning."
        ),
    ] = None,
    seed: options.Seed = 1,
    schedule: Annotated[str, typer.Option(help="Training schedule: laptop, or paper, which needs a GPU.")] = "laptop",
    epochs: Annotated[int | None, typer.Option(min=1, help="Epochs at most; the schedule's if left out.")] = None,
    images: Annotated[int | None, typer.Option(min=1, help="Images per simulator; all if left out.")] = None,
    learning_rate: Annotated[float, typer.Option(min=1e-7, max=1.0, help="Learning rate of Adam.")] = 1e-4,
    weights_at: Annotated[str, typer.Option(help="Steps after which weights are written, too: 100,200,400.")] = "",
    threads: Annotated[int, typer.Option(min=1, help="CPU threads.")] = 2,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda.")] = "auto",
    trust: options.Trust = None,
) -> None:
    """Train one network for all simulators of a data set.

    Example: ds train --data data --out trained --network dave2
    """
    from ds_driver.networks.weights import architecture_in, path_of_weights
    from ds_driver.training import CHECKPOINT, schedule_of, train

    network = network or (architecture_in(path_of_weights(start)) if start else "dave2")
    chosen = schedule_of(schedule, network)
    plan = replace(
        chosen,
        seed=seed,
        epochs=epochs or chosen.epochs,
        images_per_simulator=images,
        learning_rate=learning_rate,
        weights_at=_steps_of(weights_at),
        threads=threads,
        device=device,
        start=start or "",
    )
    kept = f"the finished epochs are kept in {out}; the same command continues"
    with stopped(lambda: kept if (out / CHECKPOINT).is_file() else ""):
        train(data, out, plan, ScreenProgress(), trusted=trust or [])
    file = out / f"{network}.safetensors"
    print(file)
    say_next(ds_command("check", file))


def _training_of(data: Path) -> str:
    """Command that trains a network on a data set."""
    return ds_command("train", "--data", data, "--out", "networks")


def _steps_of(text: str) -> tuple[int, ...]:
    """Read steps separated by commas."""
    steps = [part.strip() for part in text.split(",") if part.strip()]
    if not all(step.isdecimal() and int(step) > 0 for step in steps):
        raise typer.BadParameter(f"{text!r}: expected steps from 1 up, separated by commas, such as 100,200,400")
    return tuple(int(step) for step in steps)


@verb(app, "models")
def models_command() -> Result:
    """List the shipped networks and their success rates.

    Example: ds models
    """
    from ds_driver.networks.weights import SHIPPED, shipped_networks

    document = []
    for name, path in shipped_networks().items():
        card = read_json(path.with_suffix(".json"))
        size = next(SHIPPED.glob(f"{name}.[so][an]*")).stat().st_size  # .safetensors, or .onnx
        document.append({"name": name, "parameters": card["parameters"], "bytes": size, "card": card})

    def show() -> None:
        table = Table("name", "parameters", "bytes", "success on unseen roads")
        for row in document:
            success = ", ".join(
                f"{name} {sum(rates.values()) / len(rates):.2f}" for name, rates in row["card"]["success"].items()
            )
            table.add_row(row["name"], f"{row['parameters']:,}", f"{row['bytes']:,}", success)
        Console().print(table)

    return Result(document=document, show=show, next="ds check dave2")


sim2real_app = typer.Typer()


@verb(sim2real_app, "train")
def sim2real_train_command(
    real: Annotated[
        Path, typer.Option("--real", help="Photographs from the right lane: a Donkey Car tub, a bag, or a folder.")
    ],
    out: Annotated[Path, typer.Option(help="Folder; a training that was stopped there is resumed.")],
    sim: options.Simulator = SimulatorName("bullet"),
    preset: Annotated[
        Literal["laptop", "fast", "paper"], typer.Option(help="Sizes and duration; paper needs a GPU.")
    ] = "laptop",
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Seed of weights, order and drives.")] = 1,
    epochs: Annotated[int | None, typer.Option(min=1, max=1000, help="Epochs; the preset's if left out.")] = None,
    threads: Annotated[int, typer.Option(min=1, max=256, help="Threads of PyTorch.")] = 2,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda.")] = "auto",
    unlike: Annotated[
        list[Path] | None,
        typer.Option(metavar="DIR", help="Data set whose roads must not be among the simulated ones; repeatable."),
    ] = None,
) -> Result:
    """Train a generator for one simulator's images.

    The generator makes simulated images look like your photographs. The simulated ones come from random roads that the
    autopilot drives.

    Example: ds sim2real train --sim bullet --real my_tub --out s2r_bullet
    """
    from ds_driver.sim2real.preparation import make_domains
    from ds_driver.sim2real.settings import PRESETS
    from ds_driver.sim2real.trainer import EPOCHS, train
    from ds_driver.training import CHECKPOINT

    settings = replace(PRESETS[preset], seed=seed, threads=threads, device=device)
    settings = replace(settings, epochs=epochs or settings.epochs)
    kept = f"the finished epochs are kept in {out}; the same command continues"
    with stopped(lambda: kept if (out / CHECKPOINT).is_file() else ""):
        domains = make_domains(sim, real, out, settings, ScreenProgress(), data_sets=unlike or [])
        for warning in domains.warnings:
            say(f"warning: {warning}")
        history = train(domains, settings, out, ScreenProgress())
    document = {
        "simulator": sim,
        "crop": {"simulated": asdict(domains.match.simulated), "real": asdict(domains.match.real)},
        "difference": domains.match.difference,
        "warnings": list(domains.warnings),
        "losses": history,
        "epochs": str(out / EPOCHS),
    }
    newest = max((out / EPOCHS).glob("*.safetensors"))
    following = ds_command("sim2real", "translate", "data", "--generator", newest, "--out", "translated")
    return Result(document=document, show=lambda: print(out / EPOCHS), next=following)


@verb(sim2real_app, "translate")
def sim2real_translate_command(
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="Data set of simulated drives, bag, or tub.")],
    out: Annotated[Path, typer.Option(help="Folder to write; a translation that was stopped there is resumed.")],
    generator: Annotated[
        Path, typer.Option(help="Generator, a .safetensors file; a set of them for a data set of several simulators.")
    ],
    backend: Annotated[str, typer.Option(help="onnx, openvino, openvino-bf16 or torch.")] = "onnx",
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes for a data set; as many as processors if left out.")
    ] = None,
) -> Result:
    """Translate the images of a data set, bag or tub; the same format out.

    Example: ds sim2real translate data --generator generators --out data_real
    """
    from ds_driver.networks.weights import shipped_sets
    from ds_driver.sim2real.generator import load_generator
    from ds_driver.sim2real.image_translation import Translator, open_set
    from ds_driver.sim2real.translation import translate

    files = [generator]
    if generator.is_dir() or str(generator) in shipped_sets():
        files = list(open_set(str(generator)).files.values())
    translators = (Translator(load_generator(file), backend) for file in files)
    with stopped(lambda: f"what is translated is kept in {out}; the same command continues"):
        count = sum(translate(source, out, one, ScreenProgress(), workers=workers) for one in translators)
    document = {"out": str(out), "translated": count}
    following = ds_command("train", "--data", out, "--out", "networks")
    return Result(document=document, show=lambda: print(out), next=following)
