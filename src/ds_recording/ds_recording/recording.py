# SPDX-License-Identifier: Apache-2.0
"""Images, times and commands of the longest stretch of a recording that has no gaps, and whether they make sense."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_driver.data.recordings import Reading, Recording, open_recording
from ds_recording import RecordingError
from ds_recording.lines import CENTRES
from ds_recording.odometry import Source, read_sources
from ds_road.road import abbreviated

Array = NDArray[np.float64]
LONGEST_GAP = 0.5
"""Time between two images that ends a stretch, s; chosen: ten images, in which a car leaves what it has seen."""
SHORTEST = 60
"""Images of a stretch that can be located; chosen: three seconds at 20 Hz, after which a network may leave its lane."""
MOST_FRAMES = 4000
"""Images of a stretch that are used; chosen: 200 s at 20 Hz, solved in a minute."""
MOST_READ = 200_000
"""Images of a recording; chosen: three hours at 20 Hz."""
PERIODS = (0.01, 0.25)
"""Least and largest median time between images, s; chosen: beyond, no camera of a car, or no common motion."""
LEAST_ORDERED = 0.95
"""Share of the images that must be later than the one before; chosen: sessions may be mixed, and a clock set once."""
WIDEST_IMAGE = 320
"""Columns to which wider images are shrunk; chosen: lines are then as many pixels wide as they are checked with."""
LARGEST_SIDE = 4096
SIZES = (16, LARGEST_SIDE)
"""Least and largest side of an image, px; chosen: cameras of 4K."""


@dataclass(frozen=True, kw_only=True)
class Views:
    """One stretch."""

    recording: Recording
    total: int  # images of the whole recording
    frames: NDArray[np.int64]  # index of each image in the recording, (n,)
    seconds: Array  # time since the first image of the recording, (n,), increasing
    # (rows, columns, 3) uint8 RGB, n of them, shrunk to `WIDEST_IMAGE`.
    images: list[NDArray[np.uint8]] = field(repr=False)
    size: tuple[int, int]  # columns and rows of the images as recorded
    steering: Array  # -1 full left to +1 full right; NaN where unknown, (n,)
    throttle: Array  # NaN where unknown, (n,)
    odometry: list[Source]
    centre: str  # colour of the centre line, a key of `ds_recording.lines.CENTRES`


def read_views(path: Path, reading: Reading, odometry: str | None = None, centre: str = "yellow") -> Views:
    """Read the longest stretch without gaps, or the first `MOST_FRAMES` of it; for `odometry` see `read_sources`.

    Raises:
        RecordingError: an unknown colour, too few images, or times that make no sense.
        ds_bags.layout.BagError: neither a bag nor a tub, or a damaged one.
    """
    if centre not in CENTRES:
        raise RecordingError(
            f"centre line {abbreviated(centre)}, expected {', '.join(CENTRES)}: red and orange count as yellow"
        )
    recording = open_recording(path, reading)
    rows: list[tuple[int, float]] = []
    sizes: set[tuple[int, int]] = set()
    total, start = 0, 0.0
    for frame in recording.frames():
        total, start = total + 1, frame.start
        if total > MOST_READ:
            raise RecordingError(f"{path}: more than {MOST_READ} images: split the recording")
        if frame.image is not None:
            rows.append((frame.index, frame.seconds))
            sizes.add((frame.image.shape[1], frame.image.shape[0]))
            if len(sizes) > 1 or not SIZES[0] <= min(min(sizes)) <= max(max(sizes)) <= SIZES[1]:
                sizes_in_words = " and ".join(f"{w} x {h}" for w, h in sorted(sizes))
                expected = f"expected one size, of {SIZES[0]} to {SIZES[1]} px a side"
                raise RecordingError(f"{path}: images of {sizes_in_words} px: {expected}")
    seconds = np.array([row[1] for row in rows])
    first, end = longest_stretch(path, seconds, total)
    kept: list[NDArray[np.uint8]] = []
    commands = []
    readable = ((frame, frame.image) for frame in recording.frames() if frame.image is not None)
    for frame, image in islice(readable, first, end):
        kept.append(shrunk(image))
        commands.append([np.nan if v is None else v for v in (frame.steering, frame.throttle)])
    values = np.array(commands, dtype=np.float64)
    return Views(
        recording=recording,
        total=total,
        frames=np.array([row[0] for row in rows[first:end]], dtype=np.int64),
        seconds=seconds[first:end],
        images=kept,
        size=next(iter(sizes)),
        steering=values[:, 0],
        throttle=values[:, 1],
        odometry=read_sources(recording, start, odometry),
        centre=centre,
    )


def longest_stretch(path: Path, seconds: Array, total: int) -> tuple[int, int]:
    """First image and end of the longest stretch without gaps, at most `MOST_FRAMES` long, of those to be read."""
    if len(seconds) < SHORTEST:
        raise RecordingError(
            f"{path}: {len(seconds)} of {total} images can be read, expected at least {SHORTEST}: record a longer drive"
        )
    steps = np.diff(seconds)
    ordered = float((steps > 0.0).mean())
    if not np.isfinite(seconds).all() or ordered < LEAST_ORDERED:
        raise RecordingError(
            f"{path}: {1.0 - ordered:.0%} of the images are no later than the one before: the times make no sense, or "
            "the images are not in the order in which they were taken: record it again"
        )
    period = float(np.median(steps))
    if not PERIODS[0] <= period <= PERIODS[1]:
        raise RecordingError(
            f"{path}: images are {1000 * period:.3g} ms apart in the median, expected {1000 * PERIODS[0]:g} to "
            f"{1000 * PERIODS[1]:g}: the times make no sense, so nothing can be said about motion"
        )
    cuts = np.flatnonzero((steps <= 0.0) | (steps > LONGEST_GAP)) + 1
    edges = np.concatenate(([0], cuts, [len(seconds)]))
    longest = int(np.argmax(np.diff(edges)))
    first, end = int(edges[longest]), int(edges[longest + 1])
    if end - first < SHORTEST:
        raise RecordingError(
            f"{path}: the longest stretch without gaps of {LONGEST_GAP:g} s has {end - first} of {total} images, "
            f"expected at least {SHORTEST}: record without interruptions"
        )
    return first, min(end, first + MOST_FRAMES)


def shrunk(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Shrink an image wider than `WIDEST_IMAGE`, keeping its aspect ratio."""
    height, width = image.shape[:2]
    if width <= WIDEST_IMAGE:
        return image
    size = (WIDEST_IMAGE, max(round(height * WIDEST_IMAGE / width), 1))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
