"""Which images of a data set a generator translated; the generator is kept beside them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Collection, Mapping
from pathlib import Path

from ds_bags.layout import TRANSLATED
from ds_driver.data.dataset import IMPORTED, DatasetError, imported_names
from ds_driver.whole_files import whole_file
from ds_sim.registry import label_of

GENERATOR = "generator.safetensors"
"""File of the generator, in the folder of its simulator's drives."""


def translated_by(data: Path, names: Collection[str]) -> dict[str, str]:
    """Return which generators translated a data set: simulator -> SHA-256; empty if its images are plain.

    Args:
        data: folder of the data set.
        names: names of the simulators and recordings in its samples.

    Raises:
        DatasetError: some simulators' images are translated and others' are not, or a mark is damaged.
    """
    recorded = imported_names(data)
    digests = {name: _digest(data / name / IMPORTED) for name in sorted(names) if name in recorded}
    translated = {name: digest for name, digest in digests.items() if digest}
    plain = sorted(set(names) - recorded)
    if translated and plain:
        raise DatasetError(
            f"{data} has translated images of {', '.join(translated)} and plain ones of {', '.join(plain)}: a network "
            "sees either; translate all simulators with `ds sim2real translate`"
        )
    return translated


def copy_generators(data: Path, digests: Mapping[str, str], folder: Path) -> None:
    """Copy the generators of a data set to a folder, created if missing, as `SIMULATOR.safetensors`.

    Raises:
        DatasetError: the data set does not hold one.
    """
    for name in digests:
        source = data / name / GENERATOR
        if not source.is_file():
            raise DatasetError(f"{source} is missing: translate the data set again")
        folder.mkdir(parents=True, exist_ok=True)
        with whole_file(folder / f"{label_of(name)}.safetensors") as partial:
            shutil.copyfile(source, partial)


def _digest(mark: Path) -> str:
    try:
        about = json.loads(mark.read_text())
        return str(about.get(TRANSLATED, ""))
    except (OSError, ValueError, AttributeError, RecursionError):
        raise DatasetError(f"{mark} is damaged: import or translate these images again") from None
