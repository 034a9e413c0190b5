# SPDX-License-Identifier: Apache-2.0
"""Data sets: one Parquet file with JPEG images per drive; the crops and generators of their simulators."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from ds_bags.layout import TRANSLATED
from ds_base.bounded_file import FileError, read_json, read_regular
from ds_base.bounded_tables import read_parquet
from ds_base.errors import InputError
from ds_base.folder_files import whole_file, write_json, write_whole
from ds_base.installation import ds_command
from ds_driver.networks.images import Crop, ImageError, rgb_of_file
from ds_driver.sim2real.generator import LARGEST_FILE
from ds_sim.registry import label_of, received_simulator, spec_of

_READ = ["image", "steering", "simulator", "road_id", "step", "speed"]
JPEG_BEGIN, JPEG_END = b"\xff\xd8", b"\xff\xd9"
MOST_UNEQUAL = 2.0
"""Largest ratio between the numbers of images of two simulators; chosen: a larger one means that drives failed."""
IMPORTED = "imported.json"
"""File that marks the folder of imported recordings."""
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
"""image: JPEG of (160, 320, 3) RGB; steering: label of the autopilot in [-1, 1], or recorded; speed: m/s;
lateral_position: m; recordings have neither throttle nor lateral position."""
_LIKE: dict[pa.DataType, tuple[Callable[[pa.DataType], bool], ...]] = {
    pa.binary(): (pa.types.is_binary, pa.types.is_large_binary),
    pa.string(): (pa.types.is_string, pa.types.is_large_string),
    pa.float32(): (pa.types.is_floating,),
    pa.int32(): (pa.types.is_integer,),
}
"""Type of a column -> what accepts it in any width, as others write wider types."""
LARGEST_DATASET = 8 * 2**30
"""Largest size of all images, which training holds in memory, bytes; chosen: five times the paper's data."""
LONGEST_NAME = 4096
"""Longest name of a simulator, which may contain a path, or road id, characters."""
GENERATOR = "generator.safetensors"
"""File of the generator, in the folder of its simulator's drives."""


class DatasetError(InputError):
    """The data set cannot be used."""


@dataclass(frozen=True, kw_only=True)
class Sample:
    """Labelled image, still encoded.

    Attributes:
        jpeg: of (160, 320, 3) RGB.
        steering: label in [-1, 1].
        simulator: its name, or that of the recordings.
        road_id: of the road, of the road that it is a mutant of, or of a block of a recording.
        drive: name of its file.
        step: frames since the start of the drive; 0 if not recorded.
        speed: m/s; 0 if not recorded.
    """

    jpeg: bytes
    steering: float
    simulator: str
    road_id: str
    drive: str = ""
    step: int = 0
    speed: float = 0.0


def decode(jpeg: bytes) -> NDArray[np.uint8]:
    """Decode a JPEG to (160, 320, 3) uint8 RGB; a DatasetError if it is damaged."""
    try:
        return rgb_of_file(jpeg)
    except ImageError:
        raise DatasetError("an image of the data set is damaged: collect its drive again") from None


def drive_path(folder: Path, simulator: str, road_id: str, direction: str) -> Path:
    """Return the path of the file of one drive."""
    return folder / simulator / f"{road_id}-{direction}.parquet"


def road_ids(folder: Path) -> set[str]:
    """Return the ids of all roads of a data set, from the names of its files."""
    return {path.name.rpartition("-")[0].partition("+")[0] for path in folder.glob("*/*.parquet")}


def keep_import(folder: Path, name: str, about: dict[str, object]) -> None:
    """Mark a name as imported recordings, whose images are not cropped."""
    write_json(folder / name / IMPORTED, about)


def imported_names(folder: Path) -> set[str]:
    """Return the names in a data set that denote recordings instead of simulators."""
    return {path.parent.name for path in folder.glob(f"*/{IMPORTED}")}


def write_drive(path: Path, rows: list[dict[str, object]]) -> None:
    """Write one drive; the file appears whole or not at all."""
    with whole_file(path) as partial:
        pq.write_table(pa.Table.from_pylist(rows, schema=SCHEMA), partial, compression="none")


def read_samples(folder: Path) -> list[Sample]:
    """Read every sample of a data set, ordered by simulator, road, direction and step.

    Raises:
        DatasetError: there are no drives, a file is damaged or has another schema, an image is missing or truncated, a
            label is out of range, a number is not finite, or the data set exceeds `LARGEST_DATASET`.
    """
    files = sorted(folder.glob("*/*.parquet"))
    if not files:
        raise DatasetError(f"no drives in {folder}: collect some with `{ds_command('collect', '--out', folder)}`")
    samples, size = list[Sample](), 0
    for file in files:
        table = read_drive(file)
        size += int(table.nbytes)
        if size > LARGEST_DATASET:
            raise DatasetError(f"{folder} has more than {LARGEST_DATASET // 2**30} GiB of images: split it")
        columns = (table[name].to_pylist() for name in _READ)
        samples += [
            Sample(jpeg=image, steering=label, simulator=name, road_id=road, drive=file.stem, step=step, speed=speed)
            for image, label, name, road, step, speed in zip(*columns, strict=True)
        ]
    return samples


def read_drive(file: Path) -> pa.Table:
    """Check a drive's file as `read_samples` does; return its columns `_READ`, with 0 for missing steps and speeds."""
    try:
        table = read_parquet(file)
    except (FileError, OSError) as error:
        raise DatasetError(f"{file} cannot be read ({error}): collect it again") from None
    _check_schema(file, table.schema)
    for name in ("throttle", "speed", "lateral_position"):
        if name in table.column_names and not np.isfinite(table[name].drop_null().to_numpy()).all():
            raise DatasetError(f"{file} has a {name} that is not a finite number: collect it again")
    for name in ("steering", "simulator", "road_id"):
        if table[name].null_count:
            raise DatasetError(f"{file} has rows without {name}: collect it again")
    if not (np.abs(table["steering"].to_numpy()) <= 1.0).all():
        raise DatasetError(f"{file} has a steering label outside [-1, 1]: collect it again")
    for row, jpeg in enumerate(table["image"].to_pylist()):
        if not jpeg or jpeg[:2] != JPEG_BEGIN or jpeg[-2:] != JPEG_END:
            state = "cut or no JPEG" if jpeg else "missing"
            raise DatasetError(f"{file}, row {row}: the image is {state}: delete the file and collect it again")
    for name in ("simulator", "road_id"):
        longest = max(map(len, table[name].unique().to_pylist()), default=0)
        if longest > LONGEST_NAME:
            raise DatasetError(f"{file} has a {name} of {longest} characters, expected at most {LONGEST_NAME}")
    for name in ("step", "speed"):
        column = table[name] if name in table.column_names else pa.nulls(len(table), SCHEMA.field(name).type)
        table = table.drop_columns([name] if name in table.column_names else [])
        table = table.append_column(name, pc.fill_null(column, 0))
    return table.select(_READ)


def _check_schema(file: Path, schema: pa.Schema) -> None:
    for name in ("image", "steering", "simulator", "road_id"):
        if schema.names.count(name) != 1:
            raise DatasetError(f"{file} has no column {name}: collect it again")
    for field in schema:
        if schema.names.count(field.name) != 1 or field.name not in SCHEMA.names:
            raise DatasetError(f"{file} has an unknown column {field.name!r:.60}: collect it again")
        expected = SCHEMA.field(field.name).type
        if not any(is_like(field.type) for is_like in _LIKE[expected]):
            kind = f"{field.type}"[:60]
            raise DatasetError(f"{file} has {kind} in the column {field.name}, expected {expected}: collect it again")


def check_equal(samples: list[Sample]) -> None:
    """Refuse, by a DatasetError, a data set in which a simulator has less than half the images of another."""
    counts = Counter(sample.simulator for sample in samples)
    (most, many), *_, (least, few) = [*counts.most_common(), *counts.most_common()[-1:]]
    if many > MOST_UNEQUAL * few:
        raise DatasetError(
            f"{few} images of {least} and {many} of {most}: expected at most twice as many, collect the missing drives"
        )


def balance(samples: list[Sample], rng: np.random.Generator, *, limit: int | None = None) -> list[Sample]:
    """Draw the same number of samples, at most `limit`, from every simulator (paper 3.2.2), without replacement."""
    by_simulator = defaultdict[str, list[Sample]](list)
    for sample in samples:
        by_simulator[sample.simulator].append(sample)
    count = min(min(map(len, by_simulator.values())), limit or len(samples))
    chosen = []
    for _, group in sorted(by_simulator.items()):
        chosen += [group[i] for i in np.sort(rng.choice(len(group), count, replace=False))]
    return chosen


def write_manifest(folder: Path, about: dict[str, object]) -> None:
    """Write `manifest.json`: the given facts, image counts and steering histograms."""
    edges = np.linspace(-1.0, 1.0, 11)
    histograms: dict[str, list[int]] = {}
    counts = Counter[str]()
    for path in sorted(folder.glob("*/*.parquet")):
        steering, name = read_parquet(path, ["steering"])["steering"].to_numpy(), path.parent.name
        counts[name] += len(steering)
        histograms[name] = (np.histogram(steering, edges)[0] + histograms.get(name, 0)).tolist()
    document = {**about, "images": counts, "steering_bins": edges.round(1).tolist(), "steering": histograms}
    write_json(folder / "manifest.json", document)


def translated_by(data: Path, names: Collection[str]) -> dict[str, str]:
    """Return which generators translated a data set: simulator -> SHA-256; empty if plain, a DatasetError if mixed."""
    recorded = imported_names(data)
    digests = ((name, _digest(data / name / IMPORTED)) for name in sorted(names) if name in recorded)
    translated = {name: digest for name, digest in digests if digest}
    plain = sorted(set(names) - recorded)
    if translated and plain:
        raise DatasetError(
            f"{data} has translated images of {', '.join(translated)} and plain ones of {', '.join(plain)}: a network "
            "sees either; translate all simulators with `ds sim2real translate`"
        )
    return translated


def copy_generators(data: Path, digests: Mapping[str, str], folder: Path) -> None:
    """Copy a data set's generators to a folder, as `SIMULATOR.safetensors`; a DatasetError if it does not hold one."""
    for name in digests:
        source = data / name / GENERATOR
        if not source.is_file():
            raise DatasetError(f"{source} is missing: translate the data set again")
        write_whole(folder / f"{label_of(name)}.safetensors", read_regular(source, LARGEST_FILE))


def _digest(mark: Path) -> str:
    try:
        return str(read_json(mark).get(TRANSLATED, ""))
    except (OSError, ValueError, AttributeError):
        raise DatasetError(f"{mark} is damaged: import or translate these images again") from None


def crops_of(data: Path, names: Iterable[str], *, trusted: Collection[str] = ()) -> dict[str, Crop]:
    """Return the crop for each name in a data set: that of the simulator, which is shipped or trusted, or none."""
    recorded = imported_names(data)
    return {
        name: Crop() if name in recorded else Crop.of(spec_of(received_simulator(name, confirmed=trusted)))
        for name in sorted(set(names))
    }
