"""A driver answers recorded images one after the other, without losing one (paper 4.3.1, RQ1, on anybody's data)."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ds_driver.data.recordings import RecordedFrame, Recording
from ds_driver.networks.preprocessing import Crop

Array = NDArray[np.float64]
Answer = Callable[[RecordedFrame, Crop], float | None]
"""From a frame with an image to a steering from -1 full left to +1 full right; None if no answer came."""
WORST = 6
"""Images with the largest errors that are kept for a picture; chosen: as many as fit beside each other."""
APART = 10
"""Images between two of these at least; chosen: half a second, so that they show different places."""


@dataclass(frozen=True, kw_only=True)
class Answers:
    """What a driver said to one recording.

    Attributes:
        name: of the recording.
        group: that it is pooled with.
        index: (n,) of the images, those that cannot be read left out.
        seconds: (n,) since the first image.
        recorded: (n,) steering to compare with; NaN where there is none.
        answered: (n,) the driver's steering; NaN where no answer came.
        images: number of images in the recording.
        trouble: a line for each image that cannot be read.
        worst: frames with the largest errors, the largest first, with the driver's steering.
    """

    name: str
    group: str
    index: NDArray[np.int64]
    seconds: Array
    recorded: Array
    answered: Array
    images: int
    trouble: list[str]
    worst: list[tuple[RecordedFrame, float]]

    @property
    def errors(self) -> Array:
        """(m,) answered less recorded steering where there are both: positive is too far to the right."""
        both = self.answered - self.recorded
        return both[np.isfinite(both)]


def evaluate_recording(recording: Recording, answer: Answer, *, limit: int | None = None) -> Answers:
    """Show a driver every image of a recording.

    Args:
        recording: what is shown.
        answer: the driver.
        limit: only so many images.

    Raises:
        ds_bags.layout.BagError: the recording is damaged, or has no images.
    """
    rows: list[tuple[int, float, float, float]] = []
    trouble: list[str] = []
    worst: list[tuple[RecordedFrame, float]] = []
    images = 0
    for frame in recording.frames():
        if limit is not None and images >= limit:
            break
        images += 1
        if frame.image is None:
            trouble.append(frame.trouble)
            continue
        value = answer(frame, recording.crop)
        rows.append((frame.index, frame.seconds, _number(frame.steering), _number(value)))
        if value is not None and frame.steering is not None:
            worst = _with(worst, (frame, value))
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    return Answers(
        name=recording.path.resolve().name,
        group=recording.group,
        index=table[:, 0].astype(np.int64),
        seconds=table[:, 1],
        recorded=table[:, 2],
        answered=table[:, 3],
        images=images,
        trouble=trouble,
        worst=worst,
    )


def _with(
    worst: list[tuple[RecordedFrame, float]], new: tuple[RecordedFrame, float]
) -> list[tuple[RecordedFrame, float]]:
    """The worst images, those of one place represented by the worst of them."""
    near = [pair for pair in worst if abs(pair[0].index - new[0].index) < APART]
    if any(_by_error(pair) <= _by_error(new) for pair in near):
        return worst
    return sorted([pair for pair in worst if all(pair is not other for other in near)] + [new], key=_by_error)[:WORST]


def _number(value: float | None) -> float:
    return float("nan") if value is None else value


def _by_error(pair: tuple[RecordedFrame, float]) -> float:
    frame, value = pair
    return -abs(value - (frame.steering or 0.0))


def write_answers(path: Path, answers: Iterable[Answers]) -> None:
    """One row per image as CSV; a cell is empty where there is no value."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("group", "recording", "image", "seconds", "recorded", "answered", "error"))
        for one in answers:
            for index, seconds, recorded, answered in zip(
                one.index, one.seconds, one.recorded, one.answered, strict=True
            ):
                values = [seconds, recorded, answered, answered - recorded]
                cells = ["" if np.isnan(value) else repr(float(value)) for value in values]
                writer.writerow((one.group, one.name, int(index), *cells))
