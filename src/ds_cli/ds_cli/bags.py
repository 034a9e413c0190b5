# SPDX-License-Identifier: Apache-2.0
"""`ds bag`: inspect, re-simulate and repair rosbag2 recordings."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.console import Console
from rich.table import Table

from ds_base.installation import ds_command
from ds_cli import options
from ds_cli.output import Result, ScreenProgress, say, verb
from ds_sim.registry import SimulatorName

if TYPE_CHECKING:
    from ds_driver.networks.images import Crop

bag_app = typer.Typer()

BagFolder = Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a bag.")]


def _write_video(
    folder: Path, simulator: SimulatorName, video: Path, seed: int | None, trusted: Collection[str]
) -> None:
    """Render a bag's run; its images come from the re-simulation, as most bags hold none."""
    from ds_bags.reader import BagReader, read_run
    from ds_driver.networks.network_driver import translation_of
    from ds_sim.session import resimulate
    from ds_sim.video import write_video

    with BagReader(folder) as bag:
        recorded = read_run(bag, simulator=simulator, seed=seed, trusted=trusted)
        name = bag.facts.get("driver") or "recorded commands"
    try:
        translate = translation_of(options.driver_named(name), simulator)
    except ValueError as error:  # the drive is shown without
        translate = None
        say(f"no translated images: {error}")
    driver = Path(name).name
    say(f"rendering {video}")
    run = recorded.run
    frames = resimulate(simulator, run)
    write_video(video, f"{simulator}, {driver}", run.road, frames, run.commands, run.conditions, translate)


@verb(bag_app, "info")
def info_command(folder: BagFolder) -> Result:
    """Describe a bag: outcome, road, versions and topics.

    A bag of another project is described as far as it is a rosbag2 or ROS 1 bag.

    Example: ds bag info runs/seven
    """
    from rich.text import Text

    from ds_bags.info import describe, info_in_words
    from ds_bags.layout import printable

    document = describe(folder)

    def show() -> None:
        for line in info_in_words(document):
            print(line)
        table = Table("topic", "type", "messages")
        for topic in document["topics"]:
            # Names from a file are text, not markup.
            table.add_row(*(Text(printable(topic[key])) for key in ("name", "type", "messages")))
        Console().print(table)

    ours, open_loop = ds_command("bag", "redrive", folder), ds_command("bag", "drive", folder, "--driver", "dave2")
    following = ours if document["facts"].get("simulator") else open_loop
    return Result(document=document, show=show, next=following)


@verb(bag_app, "recover")
def recover_command(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of the bag, or its hidden partial folder.")],
    out: Annotated[Path | None, typer.Option(help="Folder to write; DIR_recovered if left out.")] = None,
) -> Result:
    """Recover a bag whose writer was killed.

    Example: ds bag recover runs/killed
    """
    from ds_bags.copying import recover

    bag = recover(folder, out)
    document = {key: str(value) if isinstance(value, Path) else value for key, value in asdict(bag).items()}

    def show() -> None:
        print(
            f"{bag.folder}: {bag.messages} messages over {bag.seconds:.2f} s; the last {bag.lost_bytes} bytes "
            f"of {bag.source} could not be recovered. The damaged file is kept."
        )

    return Result(document=document, show=show, next=ds_command("bag", "info", bag.folder))


@verb(bag_app, "redrive")
def redrive_command(
    folder: BagFolder,
    sim: Annotated[SimulatorName | None, options.simulator_option("Simulator in place of the recorded one.")] = None,
    video: Annotated[Path | None, typer.Option(help="Video of the run to write, .mp4.")] = None,
    trust: options.Trust = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of the run, if the bag has lost it.")] = None,
) -> Result:
    """Re-simulate a recorded run and compare it with the recording, bit by bit.

    The simulator gets the recorded road, seed and commands again, without a driver. This shows whether your
    installation reproduces the run, and what the camera saw, even if the bag holds no images. Exit status 1 if a frame
    differs.

    Example: ds bag redrive runs/seven --video run.mp4
    """
    from ds_bags.verification import verify_bag
    from ds_sim.video import check_path

    if video is not None:
        check_path(video)
    verification = verify_bag(folder, sim, seed=seed, trusted=trust or [])
    same = verification.step is None
    if video is not None and same:
        _write_video(folder, verification.simulator, video, seed, trust or [])
    shown = str(video) if video is not None and same else None
    document = {"bag": str(folder), "same": same, "video": shown} | asdict(verification)

    def show() -> None:
        images = f", and so are {verification.images} images" if verification.images else ""
        print(f"{verification.frames} frames on {verification.simulator} are identical to the recorded ones{images}")
        if shown:
            print(f"video: {shown}")

    if not same:
        no_video = "; no video was written" if video is not None else ""
        say(
            f"error: {verification.simulator} leaves the recorded run at step {verification.step}, "
            f"{verification.difference}{no_video}"
        )
    about, shown_again = ds_command("bag", "info", folder), ds_command("bag", "redrive", folder, "--video", "run.mp4")
    following = about if video else shown_again
    return Result(document=document, show=show if same else lambda: None, error=not same, next=following)


@verb(bag_app, "drive")
def drive_command(
    folders: Annotated[list[Path], typer.Argument(metavar="DIR...", help="Bags with images, and Donkey Car tubs.")],
    driver: Annotated[str, typer.Option(help="Network: dave2, or a .safetensors or .yaml file.")] = "dave2",
    out: Annotated[Path | None, typer.Option(help="Folder for errors.png, answers.csv and summary.json.")] = None,
    camera: options.ImageTopic = None,
    steering: options.RecordedSteering = None,
    factor: options.SteeringFactor = 1.0,
    rows: options.ImageRows = None,
    truth: Annotated[
        Literal["recorded", "autopilot"],
        typer.Option(help="Reference: the recorded steering, or what the autopilot would steer."),
    ] = "recorded",
    limit: Annotated[int | None, typer.Option(min=1, help="Images of each recording at most.")] = None,
    trust: options.Trust = None,
) -> Result:
    """Show recorded images to a network (open loop), and compare its steering with the recorded one.

    The network does not drive. Prints the steering errors, and distances between recordings.

    Example: ds bag drive runs/seven --driver dave2 --out open_loop
    """
    from ds_analysis.paper.open_loop import evaluate_recording, write_answers
    from ds_analysis.paper.steering_error_stats import distances, pooled_errors, summarise
    from ds_bags.layout import BagError
    from ds_base.folder_files import enter_folder, write_json
    from ds_driver.data.recordings import Reading, RecordedFrame, open_recording
    from ds_driver.networks.driver_name import AUTOPILOT
    from ds_driver.networks.network_driver import NetworkDriver
    from ds_report.error_pictures import draw_errors

    reading = Reading(
        camera=camera,
        steering=steering,
        factor=factor,
        rows=options.rows_of(rows),
        truth=truth,
        trusted=tuple(trust or ()),
    )
    recordings = [open_recording(folder, reading) for folder in folders]
    if out is not None and out.exists() and not out.is_dir():
        raise BagError(f"{out} is a file: choose another --out")
    name = options.driver_named(driver)
    if name == AUTOPILOT:
        raise BagError(
            "the autopilot follows the road, not images: give a network; `--truth autopilot` compares with it"
        )
    network = NetworkDriver(name)

    def steer(frame: RecordedFrame, crop: Crop) -> float:
        return network.command(frame.seen(crop)).steering

    progress, answers = ScreenProgress(), []
    progress.start(len(recordings))
    for recording in recordings:
        one = evaluate_recording(recording, steer, limit=limit)
        answers.append(one)
        for line in one.trouble[:3]:
            say(f"an image is left out: {line}")
        progress.advance(line=f"{recording.path}: {one.images} images")
    summaries = summarise(answers)
    apart = distances(pooled_errors(answers))
    document: dict[str, Any] = {
        "driver": driver,
        "groups": [asdict(summary) for summary in summaries],
        "distances": [{"one": one, "other": other, "wasserstein": value} for one, other, value in apart],
        "left_out": [line for one in answers for line in one.trouble],
    }
    if out is not None:
        enter_folder(out)
        write_answers(out / "answers.csv", answers)
        draw_errors(f"{Path(driver).name} on recorded images", answers, out / "errors.png")
        document |= {"answers": str(out / "answers.csv"), "picture": str(out / "errors.png")}
        write_json(out / "summary.json", document)

    def show() -> None:
        table = Table("errors on", "images", "answered", "mean", "mean size", "rms", "largest")
        for s in summaries:
            numbers = (s.mean, s.mean_absolute, s.root_mean_square, s.largest)
            cells = ["" if value is None else f"{value:.4f}" for value in numbers]
            table.add_row(s.group, str(s.images), str(s.answered), *cells)
        Console().print(table)
        for s in summaries:
            if s.compared < s.answered:
                print(f"{s.group}: {s.answered - s.compared} answers have no recorded steering to compare with")
            if s.outputs_apart is not None:
                print(f"Wasserstein distance between answers and recorded steering on {s.group}: {s.outputs_apart:.4f}")
        for one, other, value in apart:
            print(f"Wasserstein distance between the errors on {one} and on {other}: {value:.4f}")
        if out is not None:
            print(f"{out / 'errors.png'}\n{out / 'answers.csv'}")

    return Result(document=document, show=show, next=ds_command("check", driver))
