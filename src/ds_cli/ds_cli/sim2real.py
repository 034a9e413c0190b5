# SPDX-License-Identifier: Apache-2.0
"""`ds sim2real train`, `translate`: simulated images that look like photographs of a real track."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Literal

import typer

from ds_base.installation import ds_command
from ds_cli import options
from ds_cli.output import Result, ScreenProgress, say, stopped, verb
from ds_sim.registry import SimulatorName

sim2real_app = typer.Typer()


@verb(sim2real_app, "train")
def train_command(
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
    from ds_driver.sim2real.preparation import prepare_domains
    from ds_driver.sim2real.settings import PRESETS
    from ds_driver.sim2real.trainer import EPOCHS, train
    from ds_driver.training import CHECKPOINT

    settings = replace(PRESETS[preset], seed=seed, threads=threads, device=device)
    settings = replace(settings, epochs=epochs or settings.epochs)
    kept = f"the finished epochs are kept in {out}; the same command continues"
    with stopped(lambda: kept if (out / CHECKPOINT).is_file() else ""):
        domains = prepare_domains(sim, real, out, settings, ScreenProgress(), data_sets=unlike or [])
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
def translate_command(
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
