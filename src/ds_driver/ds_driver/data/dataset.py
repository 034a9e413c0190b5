"""Driving data on disk: one Parquet file per drive, images as JPEG inside, so that pandas, Arrow or DuckDB open it."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from ds_driver.data.pixels import rgb_of_file
from ds_driver.networks.preprocessing import ImageError

JPEG_BEGIN, JPEG_END = b"\xff\xd8", b"\xff\xd9"
MOST_UNEQUAL = 2.0
"""Images of the simulator with the most over those of the one with the least; chosen: more means that drives failed."""
IMPORTED = "imported.json"
"""In the folder of a name that stands for recordings."""
SCHEMA = pa.schema(
    [
        ("image", pa.binary()),
        ("steering", pa.float32()),
        ("throttle", pa.float32()),
        ("speed", pa.float32()),
        ("lateral_position", pa.float32()),
        ("step", pa.int32()),
        ("simulator", pa.string()),
        ("road_id", pa.string()),
        ("direction", pa.string()),
    ]
)
"""image: JPEG of (160, 320, 3) RGB; steering: the autopilot's label in [-1, 1], or what was recorded; speed: m/s;
lateral_position: m, null in a recording, as is the throttle."""


class DatasetError(ValueError):
    """A data set that cannot be used."""


@dataclass(frozen=True, kw_only=True)
class Sample:
    """One labelled image, still encoded.

    Attributes:
        jpeg: the image.
        steering: label in [-1, 1].
        simulator: name of the simulator it comes from.
        road_id: road on which it was taken.
    """

    jpeg: bytes
    steering: float
    simulator: str
    road_id: str


def decode(jpeg: bytes) -> NDArray[np.uint8]:
    """RGB image of JPEG bytes.

    Raises:
        DatasetError: the bytes are damaged.
    """
    try:
        return rgb_of_file(jpeg)
    except ImageError:
        raise DatasetError("an image of the data set is damaged: collect its drive again") from None


def drive_path(folder: Path, simulator: str, road_id: str, direction: str) -> Path:
    """Where the file of one drive belongs."""
    return folder / simulator / f"{road_id}-{direction}.parquet"


def keep_plan(folder: Path, plan: dict[str, object]) -> None:
    """Write down with which plan a data set is collected.

    Raises:
        DatasetError: it was begun with another one.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path, text = folder / "plan.json", json.dumps(plan, indent=1) + "\n"
    if not path.exists():
        path.write_text(text)
    elif path.read_text() != text:
        raise DatasetError(f"{folder} holds drives of another plan (see plan.json): choose another --out")


def keep_import(folder: Path, name: str, about: dict[str, object]) -> None:
    """Write down that images under a name come from recordings, whole, and not from a simulator of that name."""
    (folder / name / IMPORTED).write_text(json.dumps(about, indent=1) + "\n")


def imported_names(folder: Path) -> set[str]:
    """Names in a data set that stand for recordings."""
    return {path.parent.name for path in folder.glob(f"*/{IMPORTED}")}


def write_drive(path: Path, rows: list[dict[str, object]]) -> None:
    """Write one drive; the file appears whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial")
    pq.write_table(pa.Table.from_pylist(rows, schema=SCHEMA), partial, compression="none")
    partial.replace(path)


def read_samples(folder: Path) -> list[Sample]:
    """Every sample of a data set, ordered by simulator, road, direction and step.

    Raises:
        DatasetError: nothing there, a file that is not ours, an image missing or cut, or a label out of range.
    """
    files = sorted(folder.glob("*/*.parquet"))
    if not files:
        raise DatasetError(f"no drives in {folder}: collect some with `ds collect --out {folder}`")
    samples = []
    for file in files:
        try:
            table = pq.read_table(file, columns=["image", "steering", "simulator", "road_id"])
        except (pa.ArrowException, OSError, KeyError) as error:
            raise DatasetError(f"{file} cannot be read ({str(error).splitlines()[0]}): collect it again") from None
        steering = table["steering"].to_numpy()
        if not (np.isfinite(steering).all() and (np.abs(steering) <= 1.0).all()):
            raise DatasetError(f"{file} has a steering label outside [-1, 1]: collect it again")
        for row, jpeg in enumerate(table["image"].to_pylist()):
            if not jpeg or jpeg[:2] != JPEG_BEGIN or jpeg[-2:] != JPEG_END:
                state = "cut or no JPEG" if jpeg else "missing"
                raise DatasetError(f"{file}, row {row}: the image is {state}: delete the file and collect it again")
        columns = (table[name].to_pylist() for name in ("image", "steering", "simulator", "road_id"))
        samples += [
            Sample(jpeg=jpeg, steering=label, simulator=simulator, road_id=road_id)
            for jpeg, label, simulator, road_id in zip(*columns, strict=True)
        ]
    return samples


def check_equal(samples: list[Sample]) -> None:
    """Refuse simulators that are too unequally represented to be made equal by leaving images out.

    Raises:
        DatasetError: one has less than half the images of another.
    """
    counts = Counter(sample.simulator for sample in samples)
    (most, many), *_, (least, few) = [*counts.most_common(), *counts.most_common()[-1:]]
    if many > MOST_UNEQUAL * few:
        raise DatasetError(
            f"{few} images of {least} and {many} of {most}: expected at most twice as many, collect the missing drives"
        )


def balance(samples: list[Sample], rng: np.random.Generator, *, limit: int | None = None) -> list[Sample]:
    """The same number of samples from every simulator (paper 3.2.2), drawn without replacement.

    Args:
        samples: any number per simulator.
        rng: draws the samples.
        limit: at most so many per simulator.
    """
    by_simulator: dict[str, list[Sample]] = {}
    for sample in samples:
        by_simulator.setdefault(sample.simulator, []).append(sample)
    count = min(min(map(len, by_simulator.values())), limit or len(samples))
    chosen = []
    for name in sorted(by_simulator):
        group = by_simulator[name]
        chosen += [group[i] for i in np.sort(rng.choice(len(group), count, replace=False))]
    return chosen


def write_manifest(folder: Path, about: dict[str, object]) -> None:
    """Describe a data set beside its drives: how it was made, and how its steering is spread."""
    edges = np.linspace(-1.0, 1.0, 11)
    counts: dict[str, int] = {}
    histograms: dict[str, list[int]] = {}
    for path in sorted(folder.glob("*/*.parquet")):
        steering = pq.read_table(path, columns=["steering"])["steering"].to_numpy()
        name = path.parent.name
        counts[name] = counts.get(name, 0) + len(steering)
        histogram = np.histogram(steering, edges)[0]
        histograms[name] = (np.asarray(histograms.get(name, 0)) + histogram).tolist()
    document = {**about, "images": counts, "steering_bins": edges.round(1).tolist(), "steering": histograms}
    (folder / "manifest.json").write_text(json.dumps(document, indent=1) + "\n")
