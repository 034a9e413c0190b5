# SPDX-License-Identifier: Apache-2.0
"""`ds bag drive`: a network's steering on recorded images, open loop."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from ds_base.atomic_files import write_json
from ds_base.folder_files import enter_folder
from ds_base.installation import ds_command
from ds_cli.options import driver_named
from ds_cli.output import Interrupted, Result, ScreenProgress, say

if TYPE_CHECKING:
    from ds_analysis.paper.open_loop import Answer
    from ds_driver.data.recordings import Reading, RecordedFrame
    from ds_driver.networks.driver_name import DriverName
    from ds_driver.networks.images import Crop


def bag_drive(folders: list[Path], driver: str, reading: Reading, out: Path | None, limit: int | None) -> Result:
    """Show recorded images to a driver and compare its steering with the recorded one.

    Args:
        folders: bags and tubs.
        driver: name of a network.
        reading: which topics and image rows to read.
        out: folder for picture, answers and summary, or None.
        limit: images of each recording at most.

    Raises:
        ds_bags.layout.BagError: `out` is a file, or the driver is the autopilot.
        Interrupted: the user stopped it; nothing is written.
    """
    from ds_analysis.paper.open_loop import evaluate_recording, write_answers
    from ds_analysis.paper.steering_error_stats import distances, pooled_errors, summarise
    from ds_bags.layout import BagError
    from ds_driver.data.recordings import open_recording
    from ds_report.steering_error_pictures import draw_errors

    recordings = [open_recording(folder, reading) for folder in folders]
    if out is not None and out.exists() and not out.is_dir():
        raise BagError(f"{out} is a file: choose another --out")
    answer = _network(driver_named(driver))
    progress, answers = ScreenProgress(), []
    progress.start(len(recordings))
    try:
        for recording in recordings:
            one = evaluate_recording(recording, answer, limit=limit)
            answers.append(one)
            for line in one.trouble[:3]:
                say(f"an image is left out: {line}")
            progress.advance(line=f"{recording.path}: {one.images} images")
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


def _network(driver: DriverName) -> Answer:
    from ds_bags.layout import BagError
    from ds_driver.networks.driver_name import AUTOPILOT
    from ds_driver.networks.network_driver import NetworkDriver

    if driver == AUTOPILOT:
        raise BagError(
            "the autopilot follows the road, not images: give a network; `--truth autopilot` compares with it"
        )
    network = NetworkDriver(driver)

    def answer(frame: RecordedFrame, crop: Crop) -> float:
        return network.command(frame.seen(crop)).steering

    return answer
