"""Reads real photographs: a Donkey Car tub, a bag, or a folder of images."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ds_bags.donkey_tub import is_tub, read_tub
from ds_driver.data.recordings import MAX_IMAGE_FILE, Reading, open_recording
from ds_driver.networks.images import ImageError, rgb_of_file
from ds_driver.sim2real.settings import HELD_OUT
from ds_driver.sim2real.window import Sim2RealError, resize
from ds_sim.bounded_yaml import BoundedYamlError, read_bounded

Item = TypeVar("Item")
SUFFIXES = (".jpg", ".jpeg", ".png")
LARGEST_WIDTH = 640
"""Columns to which larger photographs are reduced; chosen: twice what the largest generator sees."""
FEWEST = 20
"""Fewest photographs; chosen: a fifth is held out, and lines are measured on the others."""


def read_photographs(source: Path, *, limit: int | None = None) -> NDArray[np.uint8]:
    """Read photographs in their order, evenly chosen if there are more than `limit`.

    Args:
        source: tub, bag, or folder of JPEG and PNG files, which are read in the order of their names.
        limit: largest number of photographs.

    Returns:
        (n, rows, columns, 3) uint8 RGB.

    Raises:
        Sim2RealError: there are too few, one is damaged, or they differ in size.
        ds_bags.layout.BagError: the tub or bag is damaged.
    """
    found: list[NDArray[np.uint8]] = []
    for name, image in read_images(source, limit):
        image = _reduced(image)
        if found and image.shape != found[0].shape:
            sizes = " and ".join(f"{shape[1]} x {shape[0]}" for shape in (found[0].shape, image.shape))
            raise Sim2RealError(f"{name}: photographs of {sizes} px, expected one size: sort them into folders by size")
        found.append(image)
    if len(found) < FEWEST:
        count = {0: "no photographs", 1: "one photograph"}.get(len(found), f"{len(found)} photographs")
        raise Sim2RealError(f"{source}: {count}, expected at least {FEWEST}: JPEG or PNG files, a tub, or a bag")
    return np.stack(found)


def split(photographs: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Split photographs into those for training and the last fifth, which is held out."""
    first = len(photographs) - max(1, round(HELD_OUT * len(photographs)))
    return photographs[:first], photographs[first:]


def read_images(source: Path, limit: int | None) -> Iterator[tuple[str, NDArray[np.uint8]]]:
    """Read up to `limit` images in their order, with the name of each; raises as `read_photographs` does."""
    if not source.exists():
        raise Sim2RealError(f"{source} does not exist: expected a tub, a bag, or a folder of photographs")
    if is_tub(source):
        records = [record.image for record in read_tub(source).records if record.image is not None]
        yield from map(_decoded, _even(records, limit))
        return
    if (source / "metadata.yaml").exists() or source.suffix in (".bag", ".mcap", ".db3"):
        frames = list(open_recording(source, Reading()).frames())
        for frame in _even(frames, limit):
            if frame.image is None:
                raise Sim2RealError(f"{frame.trouble}: remove that image, or record it again")
            yield f"{source}, image {frame.index}", frame.image
        return
    if not source.is_dir():
        raise Sim2RealError(f"{source} is a file: expected a tub, a bag, or a folder of photographs")
    files = sorted(p for p in source.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith("."))
    yield from map(_decoded, _even(files, limit))


def read_photograph(file: Path) -> NDArray[np.uint8]:
    """Read one photograph, as `read_photographs` does.

    Raises:
        Sim2RealError: it is damaged.
    """
    return _reduced(_decoded(file)[1])


def _reduced(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    if image.shape[1] <= LARGEST_WIDTH:
        return image
    return resize(image, (round(image.shape[0] * LARGEST_WIDTH / image.shape[1]), LARGEST_WIDTH))


def _decoded(file: Path) -> tuple[str, NDArray[np.uint8]]:
    try:
        return str(file), rgb_of_file(read_bounded(file, MAX_IMAGE_FILE))
    except (OSError, ImageError, BoundedYamlError) as error:
        reason = getattr(error, "strerror", None) or error
        raise Sim2RealError(f"{file}: {reason}: remove that file, or copy it again") from None


def _even(items: list[Item], limit: int | None) -> list[Item]:
    if limit is None or len(items) <= limit:
        return items
    return [items[i] for i in np.linspace(0, len(items) - 1, limit).round().astype(int)]
