# SPDX-License-Identifier: Apache-2.0
"""Open-loop evaluation: a driver predicts the steering for recorded images, without driving (paper 4.3.1, RQ1)."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ds_analysis.common.statistics import Array
from ds_base.bounded_tables import csv_text
from ds_base.errors import InputError
from ds_base.folder_files import write_whole
from ds_base.progress import Progress
from ds_driver.networks.driver_name import AUTOPILOT, DriverName
from ds_driver.networks.images import Crop

if TYPE_CHECKING:
    from ds_driver.data.recordings import RecordedFrame, Recording  # libraries of bags, which a report does without

Answer: TypeAlias = "Callable[[RecordedFrame, Crop], float | None]"
"""Computes steering, -1 full left to +1 full right, from a frame with an image; None if the driver does not answer."""
WORST = 6
"""Images with the largest errors to keep for a picture; chosen: as many as fit side by side."""
REPORT_EVERY = 500
"""Images between two progress reports; chosen: a few seconds."""
APART = 10
"""Smallest number of images between two of the worst; chosen: half a second, so that they show different places."""


@dataclass(frozen=True, kw_only=True)
class OpenLoopAnswers:
    """A driver's steering on one recording, or on one simulator's images of a data set."""

    name: str
    group: str  # group with which it is pooled
    index: NDArray[np.int64]  # (n,) indices of the images; unreadable ones are left out
    seconds: Array  # (n,) s since the first image; NaN in a data set
    recorded: Array  # (n,) recorded steering; NaN if there is none
    answered: Array  # (n,) the driver's steering, not clipped, as in the authors' package; NaN without an answer
    images: int
    trouble: list[str] = field(default_factory=list)  # one line for each image that cannot be read
    # Frames with the largest errors, largest first, each with the driver's steering.
    worst: list[tuple[RecordedFrame, float]] = field(default_factory=list)

    @property
    def errors(self) -> Array:
        """(m,) answered minus recorded steering of images with both; positive is too far right."""
        both = self.answered - self.recorded
        return both[np.isfinite(both)]

    @property
    def absolute_errors(self) -> Array:
        """(m,) absolute errors."""
        return np.abs(self.errors)


class OpenLoopError(InputError):
    """Steering errors that cannot be computed or compared."""


def evaluate_recording(recording: Recording, answer: Answer, *, limit: int | None = None) -> OpenLoopAnswers:
    """Evaluate a driver on all images of a recording, or the first ones; `BagError` if it is damaged or has none."""
    rows: list[tuple[int, float, float | None, float | None]] = []
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
        rows.append((frame.index, frame.seconds, frame.steering, value))
        if value is not None and frame.steering is not None:
            worst = _with(worst, (frame, value))
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)  # None is NaN
    return OpenLoopAnswers(
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
    """Add an image to the worst ones if it belongs there; of neighbouring images only the worst is kept."""
    near = [pair for pair in worst if abs(pair[0].index - new[0].index) < APART]
    if any(_by_error(pair) <= _by_error(new) for pair in near):
        return worst
    return sorted([pair for pair in worst if all(pair is not other for other in near)] + [new], key=_by_error)[:WORST]


def _by_error(pair: tuple[RecordedFrame, float]) -> float:
    frame, value = pair
    return -abs(value - (frame.steering or 0.0))


def write_answers(path: Path, answers: Iterable[OpenLoopAnswers]) -> None:
    """Write one CSV row per image; missing values are empty."""
    rows: list[Sequence[object]] = [("group", "recording", "image", "seconds", "recorded", "answered", "error")]
    for one in answers:
        for index, seconds, recorded, answered in zip(one.index, one.seconds, one.recorded, one.answered, strict=True):
            values = [seconds, recorded, answered, answered - recorded]
            cells = ["" if np.isnan(value) else repr(float(value)) for value in values]
            rows.append((one.group, one.name, int(index), *cells))
    write_whole(path, csv_text(rows))


def predict(
    data: Path, network: DriverName, progress: Progress, *, images: int | None = None, trusted: Collection[str] = ()
) -> dict[str, OpenLoopAnswers]:
    """Run a network over a data set (`ds_driver.data.dataset`), one image at a time as in closed loop.

    Of at most so many `images` per simulator, all if None, those of a network with memory are the first ones, others
    evenly spread. The code of `trusted` user-defined simulators may run.

    Returns:
        Simulator -> answers to its images, in the order of the data set; `recorded` is the autopilot's steering.

    Raises:
        OpenLoopError: the autopilot is not a network.
        ds_driver.data.dataset.DatasetError: the data set cannot be used.
        ValueError: the network cannot be used.
    """
    from ds_driver.control.bicycle import Geometry
    from ds_driver.data.dataset import Sample, crops_of, decode, imported_names, read_samples
    from ds_driver.networks.network_driver import load_pilot
    from ds_driver.networks.pilot import NOT_SIMULATED, Frame
    from ds_sim.registry import spec_of

    if network == AUTOPILOT:
        raise OpenLoopError("the autopilot recorded the steering to compare with: name a network, such as dave2")
    pilot = load_pilot(network)
    groups: dict[str, list[Sample]] = {}
    for sample in read_samples(data):
        groups.setdefault(sample.simulator, []).append(sample)

    def chosen(group: list[Sample]) -> list[Sample]:
        if images is None or pilot.has_memory or len(group) <= images:
            return group[:images]
        return [group[k] for k in np.linspace(0, len(group) - 1, images).round().astype(int)]

    groups = {name: chosen(group) for name, group in groups.items()}
    total, done = sum(map(len, groups.values())), 0
    progress.start(total)
    answers, crops, recorded = {}, crops_of(data, groups, trusted=trusted), imported_names(data)
    for name, group in groups.items():
        if pilot.has_memory and any(b.step > a.step + 1 for a, b in pairwise(group) if a.drive == b.drive):
            raise OpenLoopError(
                f"{data} leaves out frames of {name}, and {network} remembers earlier ones: collect with --every 1"
            )
        steering = np.empty(len(group))
        spec = None if name in recorded else spec_of(name)
        for index, sample in enumerate(group):
            if index == 0 or sample.drive != group[index - 1].drive:
                pilot.start()
            frame = Frame(
                image=decode(sample.jpeg),
                speed=sample.speed,
                crop=crops[name],
                simulator=NOT_SIMULATED if spec is None else spec.name,
                vehicle=None if spec is None else Geometry.of(spec),
            )
            steering[index] = pilot.predict(frame).steering
            done += 1
            progress.advance(line=f"images, {name}" if done % REPORT_EVERY == 0 or done == total else "")
        answers[name] = OpenLoopAnswers(
            name=name,
            group=name,
            index=np.arange(len(group)),
            seconds=np.full(len(group), np.nan),
            recorded=np.array([s.steering for s in group], np.float64),
            answered=steering,
            images=len(group),
        )
    return answers
