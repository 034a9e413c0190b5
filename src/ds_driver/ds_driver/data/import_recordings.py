"""Imports recorded drives, such as those of a real car, into a data set for training (paper 3.2.2)."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ds_driver.data.dataset import DatasetError, drive_path, keep_import, write_drive
from ds_driver.data.recordings import Recording
from ds_sim.camera.encodings import jpeg
from ds_sim.registry import SIMULATORS, label_of

BLOCK = 100
"""Frames that are used together for training or for validation; chosen: 5 s at 20 Hz. Consecutive frames look alike,
so splitting them would make the validation too easy."""
DIRECTION = "recorded"
UNFINISHED = ".importing"
"""Folder of an unfinished import, which readers of data sets ignore; an import appears whole or not at all."""


@dataclass(frozen=True, kw_only=True)
class Imported:
    """Result of an import.

    Attributes:
        name: name of the recordings, in place of a simulator's.
        images: number of labelled images, now in the data set.
        unlabelled: number of images without steering, which are left out.
        files: number of files written.
    """

    name: str
    images: int
    unlabelled: int
    files: int


def import_recordings(
    recordings: list[Recording], out: Path, name: str, progress: Callable[[int, int, str], None]
) -> Imported:
    """Write recordings into a data set under a name of their own.

    Images are resized to (160, 320, 3) RGB; training does not crop them.

    Args:
        recordings: bags or tubs.
        out: folder of a data set, new or with drives on simulators.
        name: name of the recordings in training and reports.
        progress: called after each recording.

    Raises:
        DatasetError: the name is taken, an image is damaged, or nothing has a label.
        ds_bags.layout.BagError: a recording is damaged.
    """
    if name in SIMULATORS or name != label_of(name) or not name.strip("."):
        raise DatasetError(
            f"name {name!r}: expected one without {', '.join(SIMULATORS)}, slashes and spaces: choose another --name"
        )
    if (out / name).exists():
        raise DatasetError(f"{out / name} is there already: choose another --name, or delete it")
    stems = [recording.path.resolve().name for recording in recordings]
    if len(set(stems)) < len(stems):
        raise DatasetError("two recordings have the same name: rename the folder of one")
    unfinished = out / UNFINISHED
    shutil.rmtree(unfinished, ignore_errors=True)
    images = unlabelled = files = 0
    for done, (recording, stem) in enumerate(zip(recordings, stems, strict=True), start=1):
        rows: list[dict[str, object]] = []
        for frame in recording.frames():
            if frame.image is None:
                raise DatasetError(f"{frame.trouble}: remove that record, or record it again")
            if frame.steering is None:
                unlabelled += 1
                continue
            block = f"{stem}.{len(rows) // BLOCK:04d}"
            rows.append(
                {
                    "image": jpeg(frame.image),
                    "steering": frame.steering,
                    "speed": frame.speed,
                    "step": frame.index,
                    "simulator": name,
                    "road_id": block,
                    "direction": DIRECTION,
                }
            )
        for first in range(0, len(rows), BLOCK):
            part = rows[first : first + BLOCK]
            write_drive(drive_path(unfinished, name, str(part[0]["road_id"]), DIRECTION), part)
            files += 1
        images += len(rows)
        progress(done, len(recordings), f"{recording.path}: {len(rows)} images")
    if not images:
        raise DatasetError("no image has a steering beside it: name its topic with --steering TOPIC:FIELD")
    about: dict[str, Any] = {"recordings": stems, "kinds": sorted({r.kind for r in recordings}), "images": images}
    keep_import(unfinished, name, about | {"unlabelled": unlabelled, "rows": recordings[0].reading.rows})
    (unfinished / name).rename(out / name)
    unfinished.rmdir()
    return Imported(name=name, images=images, unlabelled=unlabelled, files=files)
