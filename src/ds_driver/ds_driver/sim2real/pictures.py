# SPDX-License-Identifier: Apache-2.0
"""Reads photographs, of a Donkey Car tub, a bag or a folder, and makes sheets of pictures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ds_bags.donkey_tub import is_tub, read_tub
from ds_base.progress import counted
from ds_driver.data.recordings import Reading, open_recording
from ds_driver.networks.images import ImageError, read_rgb
from ds_driver.sim2real.generator import Sim2RealError, resize
from ds_driver.sim2real.settings import HELD_OUT

SUFFIXES = (".jpg", ".jpeg", ".png")
LARGEST_WIDTH = 640
"""Columns to which larger photographs are reduced; chosen: twice what the largest generator sees."""
FEWEST = 20
"""Fewest photographs; chosen: a fifth is held out, and lines are measured on the others."""
GAP = 4
"""White pixels between pictures."""


def read_photographs(source: Path, limit: int) -> NDArray[np.uint8]:
    """Read photographs in their order, files in that of their names, evenly chosen if there are more than `limit`.

    Returns:
        (n, rows, columns, 3) uint8 RGB.

    Raises:
        Sim2RealError: there are too few, one is damaged, or they differ in size.
        ds_bags.layout.BagError: the tub or bag is damaged.
    """
    images: list[NDArray[np.uint8]] = []
    for name, image in _read_images(source, limit):
        if image.shape[1] > LARGEST_WIDTH:
            image = resize(image, (round(image.shape[0] * LARGEST_WIDTH / image.shape[1]), LARGEST_WIDTH))
        if images and image.shape != images[0].shape:
            sizes = " and ".join(f"{shape[1]} x {shape[0]}" for shape in (images[0].shape, image.shape))
            raise Sim2RealError(f"{name}: photographs of {sizes} px, expected one size: sort them into folders by size")
        images.append(image)
    if len(images) < FEWEST:
        count = {0: "no photographs", 1: "one photograph"}.get(len(images), f"{len(images)} photographs")
        raise Sim2RealError(f"{source}: {count}, expected at least {FEWEST}: JPEG or PNG files, a tub, or a bag")
    return np.stack(images)


def split(photographs: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Split photographs into those for training and the last fifth, which is held out."""
    first = len(photographs) - max(1, round(HELD_OUT * len(photographs)))
    return photographs[:first], photographs[first:]


def _read_images(source: Path, limit: int) -> Iterator[tuple[str, NDArray[np.uint8]]]:
    """Read images with the name of each; see `read_photographs`."""
    if not source.exists():
        raise Sim2RealError(f"{source} does not exist: expected a tub, a bag, or a folder of photographs")
    if is_tub(source):
        files = [file for _, file in read_tub(source).pictures]
    elif (source / "metadata.yaml").exists() or source.suffix in (".bag", ".mcap", ".db3"):
        recording = open_recording(source, Reading())
        wanted = set(evenly(sum(1 for _ in recording.frames()), limit))
        for number, frame in enumerate(recording.frames()):  # twice, as all images at once fill the memory
            if number not in wanted:
                continue
            if frame.image is None:
                raise Sim2RealError(f"{frame.trouble}: remove that image, or record it again")
            yield f"{source}, image {frame.index}", frame.image
        return
    elif not source.is_dir():
        raise Sim2RealError(f"{source} is a file: expected a tub, a bag, or a folder of photographs")
    else:
        files = sorted(p for p in source.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith("."))
    yield from (_decoded(files[i]) for i in counted(evenly(len(files), limit), str(source)))


def _decoded(file: Path) -> tuple[str, NDArray[np.uint8]]:
    try:
        return str(file), read_rgb(file)
    except ImageError as error:
        raise Sim2RealError(f"{file}: {error}: remove that file, or copy it again") from None


def evenly(count: int, limit: int) -> NDArray[np.int64]:
    """Choose at most `limit` of `count` items, evenly; return their indices."""
    return np.unique(np.linspace(0, count - 1, min(count, limit)).round().astype(np.int64))


def sheet(rows: Sequence[Sequence[NDArray[np.uint8]]]) -> NDArray[np.uint8]:
    """Arrange pictures of one size in rows, which may differ in length: (rows, columns, 3) uint8 RGB."""
    height, width = rows[0][0].shape[:2]
    longest = max(map(len, rows))
    page = np.full((len(rows) * (height + GAP) - GAP, longest * (width + GAP) - GAP, 3), 255, np.uint8)
    for top, row in zip(range(0, len(page), height + GAP), rows, strict=True):
        for left, picture in zip(range(0, page.shape[1], width + GAP), row, strict=False):
            page[top : top + height, left : left + width] = picture
    return page
