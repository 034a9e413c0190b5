"""`ds sim2real train`, `show`, `assess`, `translate`: simulated images that look like photographs of a real track."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.box import SIMPLE

from ds_cli.options import JsonFlag, Simulator
from ds_cli.output import Interrupted, Result, answer, countdown, say

if TYPE_CHECKING:
    pass

app = typer.Typer()
sim2real_app = typer.Typer(help="Make simulated images look like photographs of a real track.", no_args_is_help=True)
app.add_typer(sim2real_app, name="sim2real")

NARROW: dict[str, Any] = {"box": SIMPLE, "pad_edge": False, "padding": (0, 0)}
"""Tables of many columns in 80 of a terminal."""
Generator = Annotated[Path, typer.Argument(metavar="GENERATOR", help="Generator, a .safetensors file.")]
RealImages = Annotated[
    Path, typer.Option("--real", help="Photographs from the right lane: a Donkey Car tub, a bag, or a folder.")
]


@sim2real_app.command("train")
def train_command(
    real: RealImages,
    out: Annotated[Path, typer.Option(help="Folder; a training that was stopped there is resumed.")],
    sim: Simulator = "bullet",
    preset: Annotated[
        Literal["laptop", "fast", "paper"], typer.Option(help="Sizes and duration; paper needs a GPU.")
    ] = "laptop",
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Seed of weights, order and drives.")] = 1,
    epochs: Annotated[int | None, typer.Option(min=1, max=1000, help="Epochs; the preset's if left out.")] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Steps per epoch; the preset's if left out.")] = None,
    threads: Annotated[int, typer.Option(min=1, max=256, help="Threads of PyTorch.")] = 2,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda.")] = "auto",
    unlike: Annotated[
        list[Path] | None,
        typer.Option(metavar="DIR", help="Data set whose roads must not be among the simulated ones; repeatable."),
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Train a generator for one simulator's images.

    The simulated images come from random roads of their own, driven by the autopilot.
    """
    from ds_driver.sim2real.preparation import prepare_domains, read_sources
    from ds_driver.sim2real.settings import PRESETS
    from ds_driver.sim2real.trainer import EPOCHS, train
    from ds_driver.training import CHECKPOINT

    settings = replace(PRESETS[preset], seed=seed, threads=threads, device=device)
    changes: dict[str, Any] = {"epochs": epochs, "steps": steps}
    settings = replace(settings, **{name: value for name, value in changes.items() if value is not None})
    try:
        sources = read_sources(sim, real, out, settings, countdown(), data_sets=unlike or [])
        match = sources.match
        for name, window, position in zip(
            (sim, "photographs"), (match.simulated, match.real), match.positions, strict=True
        ):
            say(f"{name}: cropped to {window}; {position}")
        domains, warnings = prepare_domains(sources, real, out)
        for warning in warnings:
            say(f"warning: {warning}")
        history = train(domains, settings, out, say)
    except KeyboardInterrupt:
        kept = (out / CHECKPOINT).is_file()
        line = f"the finished epochs are kept in {out}; the same command continues" if kept else ""
        raise Interrupted(line) from None
    document = {
        "simulator": sim,
        "crop": {"simulated": asdict(match.simulated), "real": asdict(match.real)},
        "difference": match.difference,
        "warnings": list(warnings),
        "losses": history,
        "epochs": str(out / EPOCHS),
    }
    answer(Result(document=document, show=lambda: print(out / EPOCHS)), as_json)


@sim2real_app.command("show")
def show_command(
    generator: Generator,
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="Data set, bag, tub or folder of camera images.")],
    out: Annotated[Path, typer.Option(help="Picture to write, a .png file.")] = Path("sim2real.png"),
    count: Annotated[int, typer.Option(min=1, max=200, help="Number of images, evenly chosen.")] = 8,
    as_json: JsonFlag = False,
) -> None:
    """Draw simulated images beside their translations."""
    from ds_driver.sim2real.generator import load_generator
    from ds_driver.sim2real.pictures import camera_images, sheet
    from ds_driver.sim2real.translator import Translator
    from ds_driver.whole_files import write_whole
    from ds_sim.camera.encodings import png

    translator = Translator(load_generator(generator))
    images = [translator.prepared(image) for image in camera_images(source, translator.generator.simulator, count)]
    out.parent.mkdir(parents=True, exist_ok=True)
    write_whole(out, png(sheet([[image, translator.small(image)] for image in images])))
    answer(Result(document={"picture": str(out), "images": len(images)}, show=lambda: print(out)), as_json)


@sim2real_app.command("assess")
def assess_command(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a training.")],
    real: RealImages,
    driver: Annotated[str, typer.Option(help="Frozen network whose change of steering is measured.")] = "dave2",
    ship_to: Annotated[
        Path | None,
        typer.Option("--ship", metavar="DIR", help="Folder for the chosen generator, its card and its ONNX file."),
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Assess the checkpoints of a training on held-out frames, and choose one by the numbers."""
    from rich.console import Console
    from rich.table import Table

    from ds_driver.sim2real.evaluation.checkpoints import PHOTOGRAPHS, PLAIN, HeldOut, assess_checkpoints, ship
    from ds_driver.sim2real.preparation import read_card, read_sources, settings_of

    card = read_card(folder)
    try:
        sources = read_sources(card["simulator"], real, folder, settings_of(card), countdown(), expected=card)
        held_out = HeldOut(card["simulator"], sources.frames, sources.held_out_real, sources.match.simulated)
        document = assess_checkpoints(folder, held_out, driver, countdown())
    except KeyboardInterrupt:
        raise Interrupted from None
    files = ship(folder, document, card, ship_to) if ship_to else []
    document = document | {"shipped": [str(file) for file in files]}

    def show() -> None:
        distances = document[PLAIN]["distance"]
        table = Table("", "overlap", "px", "yellow", "white", "steer", *distances, "flicker", "bounds", **NARROW)
        for name, row in {PLAIN: document[PLAIN], **document["checkpoints"]}.items():
            lane = row["lane"]
            cells = (f"{d['value']:.2f} ({d['low']:.2f}-{d['high']:.2f})" for d in row["distance"].values())
            bounds = "" if name == PLAIN else ("broken" if row["broken"] else "kept")
            table.add_row(
                name, f"{lane['overlap']:.2f}", f"{lane['shift']:.2f}", f"{lane['found_yellow']:.2f}",
                f"{lane['found_white']:.2f}", f"{row['steering_change']['mean']:.2f}", *cells,
                f"{row['flicker']:.1f}", bounds,
            )  # fmt: skip
        Console().print(table)
        print(
            "px: sideways shift of the lines, median; yellow, white: share of the rows with the line; steer: its change"
        )
        seen = document[PHOTOGRAPHS]
        print(f"photographs show the yellow line in {seen['yellow']:.0%} of its rows, the white in {seen['white']:.0%}")
        print(f"chosen: {document['chosen'] or 'none, as all break a bound'}")
        for file in files:
            print(file)

    answer(Result(document=document, show=show), as_json)


@sim2real_app.command("translate")
def translate_command(
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="Data set of simulated drives, bag, or tub.")],
    out: Annotated[Path, typer.Option(help="Folder to write; a translation that was stopped there is resumed.")],
    generator: Annotated[
        Path, typer.Option(help="Generator, a .safetensors file; a set of them for a data set of several simulators.")
    ],
    backend: Annotated[str, typer.Option(help="onnx, openvino, openvino-bf16, openvino-int8 or torch.")] = "onnx",
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes for a data set; as many as processors if left out.")
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Translate the images of a data set, bag or tub; the same format out."""
    from ds_driver.sim2real.generator import load_generator
    from ds_driver.sim2real.stage import open_set, shipped_sets
    from ds_driver.sim2real.translation import translate
    from ds_driver.sim2real.translator import Translator

    files = [generator]
    if generator.is_dir() or str(generator) in shipped_sets():
        files = list(open_set(str(generator)).files.values())
    translators = (Translator(load_generator(file), backend) for file in files)
    try:
        count = sum(translate(source, out, one, countdown(), workers=workers) for one in translators)
    except KeyboardInterrupt:
        raise Interrupted(f"what is translated is kept in {out}; the same command continues") from None
    answer(Result(document={"out": str(out), "translated": count}, show=lambda: print(out)), as_json)


@sim2real_app.command("reality")
def reality_command(
    source: Annotated[Path, typer.Argument(metavar="TUB", help="Tub of a human's drive, with photographs.")],
    generators: Annotated[str, typer.Option(help="Shipped set or folder of generators, whose crops are used.")],
    drivers: Annotated[str, typer.Option(help="Networks, separated by commas; others are compared with the first.")],
    whole: Annotated[
        bool, typer.Option("--whole", help="All of it instead of the last fifth, for a tub that no training used.")
    ] = False,
    trained_on: Annotated[
        Path | None,
        typer.Option(metavar="TUB", help="What the generators were trained on, if TUB is of another track."),
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Compare networks' steering on real photographs with the human's: correlation and 95 % interval."""
    from rich.console import Console
    from rich.table import Table

    from ds_driver.sim2real.evaluation.reality import agreements, matched_windows, read_human_drive
    from ds_driver.sim2real.generator import Sim2RealError, load_generator
    from ds_driver.sim2real.stage import open_set

    names = [name.strip() for name in drivers.split(",") if name.strip()]
    if not names:
        raise Sim2RealError("no names: name some, as in --drivers dave2,dave2_short")
    loaded = [load_generator(file) for file in open_set(generators).files.values()]
    photographed = read_human_drive(source, whole=whole)
    windows = matched_windows(loaded, photographed, trained_on)
    try:
        found = agreements(names, photographed, windows, loaded[0].shape.size, countdown())
    except KeyboardInterrupt:
        raise Interrupted from None
    document = {
        "photographs": len(photographed.images),
        "blocks": int(photographed.blocks[-1]) + 1,
        "crops": {name: asdict(window) for name, window in windows.items()},
        "networks": [asdict(agreement) for agreement in found],
    }

    def show() -> None:
        table = Table("network", "r", "r, human smoothed", "beyond the first", *windows, **NARROW)
        for one in found:
            numbers = (one.correlation, one.smoothed, one.beyond_first)
            cells = ("" if n is None else f"{n.value:.2f} ({n.low:.2f} to {n.high:.2f})" for n in numbers)
            table.add_row(one.network, *cells, *(f"{value:.2f}" for value in one.windows.values()))
        Console().print(table)

    answer(Result(document=document, show=show), as_json)
