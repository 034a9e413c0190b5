"""`ds bag`: what is in a bag, and what can be done with it."""

from __future__ import annotations

import contextlib
import fnmatch
import json
import math
import sys
import time
from collections.abc import Collection
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.console import Console
from rich.table import Table

from ds_orchestrator.cli.options import Camera, ImageRows, JsonFlag, RecordedSteering, SteeringFactor, Trust, rows_of
from ds_orchestrator.cli.output import Interrupted, Result, answer, countdown, end, say

if TYPE_CHECKING:
    from ds_driver.data.recordings import Reading, RecordedFrame
    from ds_driver.networks.preprocessing import Crop
    from ds_orchestrator.evaluation.open_loop import Answer

app = typer.Typer()
bag_app = typer.Typer(help="Recorded runs: look into them, replay them, drive them again.", no_args_is_help=True)
app.add_typer(bag_app, name="bag")

Truth = Literal["recorded", "autopilot"]
By = Literal["cell", "run"]
BagFolder = Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a bag.")]


def bag_info(folder: Path) -> Result:
    """What is in a bag."""
    from rich.text import Text

    from ds_bags.info import describe, in_words
    from ds_bags.limits import printable

    document = describe(folder)

    def show() -> None:
        for line in in_words(document):
            print(line)
        table = Table("topic", "type", "messages")
        for topic in document["topics"]:
            # Names from a file are text, not markup.
            table.add_row(*(Text(printable(topic[key])) for key in ("name", "type", "messages")))
        Console().print(table)

    return Result(document=document, show=show)


def bag_recover(folder: Path, out: Path | None) -> Result:
    """Make a bag of what a killed writer left."""
    from ds_bags.recovery import recover

    found = recover(folder, out)
    document = {key: str(value) if isinstance(value, Path) else value for key, value in asdict(found).items()}

    def show() -> None:
        print(
            f"{found.folder}: {found.messages} messages over {found.seconds:.2f} s; the last {found.lost_bytes} bytes "
            f"of {found.source} were of no use. The remains are still there."
        )

    return Result(document=document, show=show)


def bag_replay(folder: Path, rate: float, topics: list[str], wait: float) -> Result:
    """Publish a bag to the graph."""
    from ds_bags.layout import BagError
    from ds_bags.player import Controls, play
    from ds_bags.reader import BagReader
    from ds_bags.ros.publisher import GraphOutput
    from ds_orchestrator.cli.player_keys import player_keys

    with BagReader(folder) as bag:
        if folder.suffix == ".bag":
            raise BagError(f"{folder} is a bag of ROS 1: convert it with `rosbags-convert` first")
        # A bag that tells the time itself would tell it twice.
        chosen = [c for c in bag.connections if c.topic != "/clock" and _is_wanted(c.topic, topics)]
        if not chosen:
            names = ", ".join(sorted(connection.topic for connection in bag.connections))
            raise BagError(f"{folder} has no topic {' or '.join(topics)}: it has {names}")
        try:
            with player_keys() as keys, GraphOutput(chosen, patient=math.isinf(rate)) as output:
                for topic, reason in output.skipped.items():
                    say(f"{topic} is left out: {reason}")
                if sys.stdin.isatty():
                    say("space pauses and goes on, s or the right arrow steps, q ends")
                if not output.wait_for_readers(wait) and wait:
                    say(f"nobody listens after {wait:g} s: playing all the same")
                controls = Controls(now=time.monotonic, wait=keys, tell=say)
                wanted = [c for c in chosen if c.topic not in output.skipped]
                played = play(bag.messages(wanted), output, rate=rate, controls=controls)
                skipped = dict(output.skipped)
        except KeyboardInterrupt:
            raise Interrupted from None
    document = asdict(played) | {"skipped": skipped}

    def show() -> None:
        print(f"{played.messages} messages of {played.seconds:.2f} s")

    return Result(document=document, show=show)


def _is_wanted(topic: str, patterns: list[str]) -> bool:
    return not patterns or any(fnmatch.fnmatchcase(topic, pattern) for pattern in patterns)


def _rate(text: str) -> float:
    """A speed, as a factor; infinity for `max`."""
    with contextlib.suppress(ValueError):
        value = math.inf if text == "max" else float(text)
        if value > 0.0:
            return value
    raise typer.BadParameter(f"{text!r}: expected a number above 0, or max")


def bag_redrive(folder: Path, sim: str | None, seed: int | None = None, trusted: Collection[str] = ()) -> Result:
    """Re-simulate a bag's run, and compare."""
    from ds_bags.verification import verify_bag

    found = verify_bag(folder, sim, seed=seed, trusted=trusted)
    same = found.step is None
    document = {"bag": str(folder), "same": same} | asdict(found)

    def show() -> None:
        images = f", {found.images} images too" if found.images else ""
        print(f"{found.frames} frames on {found.simulator} are the same to the last bit{images}")

    if not same:
        say(f"error: {found.simulator} leaves the recorded run at step {found.step}, {found.difference}")
    return Result(document=document, show=show if same else lambda: None, error=not same)


def bag_pack(campaign: Path, out: Path, by: By) -> Result:
    """A campaign's bags as a few."""
    from ds_bags.packs import pack
    from ds_orchestrator.campaign.bag_groups import groups_of

    progress, packs = countdown(), []
    groups = groups_of(campaign, by, say=say)
    try:
        for done, (name, bags) in enumerate(groups.items(), start=1):
            packs.append(pack(bags, out / name, {"campaign": campaign.resolve().name, "group": name}))
            progress(done, len(groups), f"{name}: {len(bags)} bags")
    except KeyboardInterrupt:
        raise Interrupted from None
    before = sum(file.stat().st_size for bags in groups.values() for bag in bags for file in bag.iterdir())
    document: dict[str, Any] = {
        "packs": [{"folder": str(one.folder), "bags": one.bags, "bytes": one.bytes} for one in packs],
        "bags": sum(one.bags for one in packs),
        "bytes": sum(one.bytes for one in packs),
        "bytes_before": before,
    }

    def show() -> None:
        print(
            f"{document['bags']} bags of {before / 1e6:.1f} MB are in {len(packs)} packs of "
            f"{document['bytes'] / 1e6:.1f} MB in {out}. The bags are still there: `ds bag unpack` makes them again."
        )

    return Result(document=document, show=show)


def bag_unpack(folder: Path, out: Path, only: str | None) -> Result:
    """Bags out of a pack."""
    from ds_bags.packs import unpack

    made = [str(path) for path in unpack(folder, out, only)]
    return Result(document={"bags": made}, show=lambda: print("\n".join(made)))


def bag_drive(
    folders: list[Path],
    driver: str,
    reading: Reading,
    out: Path | None,
    limit: int | None,
    answer: Answer | None = None,
) -> Result:
    """Let a driver answer recorded images."""
    from ds_bags.layout import BagError
    from ds_driver.data.recordings import open_recording
    from ds_orchestrator.evaluation.open_loop import evaluate_recording, write_answers
    from ds_orchestrator.evaluation.steering_error_plots import draw_errors
    from ds_orchestrator.evaluation.steering_error_stats import distances, pooled_errors, summarise

    recordings = [open_recording(folder, reading) for folder in folders]
    if out is not None and out.exists() and not out.is_dir():
        raise BagError(f"{out} is a file: choose another --out")
    answer = answer or _network(driver)
    progress, answers = countdown(), []
    try:
        for done, recording in enumerate(recordings, start=1):
            one = evaluate_recording(recording, answer, limit=limit)
            answers.append(one)
            for line in one.trouble[:3]:
                say(f"an image is left out: {line}")
            progress(done, len(recordings), f"{recording.path}: {one.images} images")
    except KeyboardInterrupt:
        raise Interrupted from None
    summaries = summarise(answers)
    apart = distances(pooled_errors(answers))
    document: dict[str, Any] = {
        "driver": driver,
        "groups": [asdict(summary) for summary in summaries],
        "distances": [{"one": one, "other": other, "wasserstein": value} for one, other, value in apart],
        "left_out": [line for one in answers for line in one.trouble],
    }
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        write_answers(out / "answers.csv", answers)
        draw_errors(f"{Path(driver).name} on recorded images", answers, out / "errors.png")
        document |= {"answers": str(out / "answers.csv"), "picture": str(out / "errors.png")}
        (out / "summary.json").write_text(json.dumps(document, indent=1, allow_nan=False) + "\n")

    def show() -> None:
        table = Table("errors on", "images", "answered", "mean", "mean size", "rms", "largest")
        for s in summaries:
            numbers = (s.mean, s.mean_absolute, s.root_mean_square, s.largest)
            cells = ["" if value is None else f"{value:.4f}" for value in numbers]
            table.add_row(s.group, str(s.images), str(s.answered), *cells)
        Console().print(table)
        for s in summaries:
            if s.compared < s.answered:
                print(f"{s.group}: {s.answered - s.compared} answers have no recorded steering beside them")
            if s.outputs_apart is not None:
                print(f"Wasserstein distance between answers and recorded steering on {s.group}: {s.outputs_apart:.4f}")
        for one, other, value in apart:
            print(f"Wasserstein distance between the errors on {one} and on {other}: {value:.4f}")
        if out is not None:
            print(f"{out / 'errors.png'}\n{out / 'answers.csv'}")

    return Result(document=document, show=show)


def _network(driver: str) -> Answer:
    from ds_bags.layout import BagError
    from ds_driver.closed_loop.simulation import AUTOPILOT
    from ds_driver.networks.network_driver import NetworkDriver

    if driver == AUTOPILOT:
        raise BagError("the autopilot looks at the road, not at images: give a network; `--truth autopilot` compares")
    network = NetworkDriver(driver)

    def answer(frame: RecordedFrame, crop: Crop) -> float:
        assert frame.image is not None
        return network.steering(frame.image, crop)

    return answer


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


@bag_app.command("replay")
def replay_command(
    folder: BagFolder,
    rate: Annotated[str, typer.Option(help="Times real time, such as 0.5; or max.")] = "1",
    topics: Annotated[list[str] | None, typer.Option(help="Only these; * stands for anything. Again for more.")] = None,
    wait: Annotated[float, typer.Option(min=0.0, help="At most so many s for a first subscriber.")] = 3.0,
    as_json: JsonFlag = False,
) -> None:
    """Publish a bag to the graph, with /clock; space pauses, s or the right arrow steps, q ends."""
    answer(
        bag_replay(folder, _rate(rate), [name for entry in topics or [] for name in entry.split(",")], wait), as_json
    )


@bag_app.command("redrive")
def redrive_command(
    folder: BagFolder,
    sim: Annotated[str | None, typer.Option(help="Simulator in place of the recorded one.")] = None,
    trust: Trust = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of the run, if the bag has lost it.")] = None,
    as_json: JsonFlag = False,
) -> None:
    """Re-simulate the recorded commands on the recorded simulator; every bit must come out the same."""
    end(bag_redrive(folder, sim, seed, trust or []), as_json)


@bag_app.command("drive")
def drive_command(
    folders: Annotated[list[Path], typer.Argument(metavar="DIR...", help="Bags with images, Donkey Car tubs.")],
    driver: Annotated[str, typer.Option(help="dave2, or a weights file.")] = "dave2",
    out: Annotated[Path | None, typer.Option(help="Folder for errors.png, answers.csv and summary.json.")] = None,
    camera: Camera = None,
    steering: RecordedSteering = None,
    factor: SteeringFactor = 1.0,
    rows: ImageRows = None,
    truth: Annotated[Truth, typer.Option(help="Compare with the recorded steering, or the autopilot's.")] = "recorded",
    limit: Annotated[int | None, typer.Option(min=1, help="Only so many images of each.")] = None,
    trust: Trust = None,
    attach: Annotated[bool, typer.Option(help="Ask the driver node that runs in this ROS domain.")] = False,
    namespace: Annotated[str, typer.Option(help="Where that node looks for its simulator.")] = "/ds1",
    as_json: JsonFlag = False,
) -> None:
    """Let a driver answer recorded images one by one: its steering errors, their density and distances."""
    from ds_driver.data.recordings import Reading

    reading = Reading(
        camera=camera,
        steering=steering,
        factor=factor,
        rows=rows_of(rows),
        truth=truth,
        trusted=tuple(trust or ()),
    )
    if not attach:
        answer(bag_drive(folders, driver, reading, out, limit), as_json)
        return
    from ds_driver.ros.driver_client import DriverClient

    with DriverClient(namespace) as node:
        node.wait_for_driver()
        answer(bag_drive(folders, "attached", reading, out, limit, node), as_json)


@bag_app.command("pack")
def pack_command(
    campaign: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a campaign.")],
    out: Annotated[Path, typer.Option(help="Folder for the packs.")],
    by: Annotated[By, typer.Option(help="One pack per cell of the feature map, or per run of the search.")] = "cell",
    as_json: JsonFlag = False,
) -> None:
    """Put a campaign's many bags into a few, which any reader opens; each run under its own name."""
    answer(bag_pack(campaign, out, by), as_json)


@bag_app.command("unpack")
def unpack_command(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a pack.")],
    out: Annotated[Path, typer.Option(help="Folder for the bags.")],
    bag: Annotated[str | None, typer.Option(help="Only the bag of this name.")] = None,
    as_json: JsonFlag = False,
) -> None:
    """Take bags out of a pack, byte for byte as they were."""
    answer(bag_unpack(folder, out, bag), as_json)
