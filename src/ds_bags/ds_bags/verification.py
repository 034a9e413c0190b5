# SPDX-License-Identifier: Apache-2.0
"""Re-simulates a recorded run from its commands, and compares states, and images if the bag has them, bit by bit."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ds_bags.layout import BagError, printable
from ds_bags.reader import COMPRESSED, IMAGE, BagReader, RecordedRun, read_run, stamp_of
from ds_sim.registry import SimulatorName
from ds_sim.session import ResimulationError, resimulate
from ds_sim.simulator import Observation


@dataclass(frozen=True, kw_only=True)
class Verification:
    """Result of a re-simulation on a simulator: numbers of identical frames and images, and where a step differs."""

    simulator: SimulatorName
    frames: int
    images: int
    step: int | None = None
    difference: str = ""


def verify_bag(
    folder: Path, simulator: SimulatorName | None = None, *, seed: int | None = None, trusted: Collection[str] = ()
) -> Verification:
    """Re-simulate the run of a bag and compare it with the recording.

    Arguments are those of `read_run`; another simulator than the recorded one may be used.

    Raises:
        ds_bags.layout.BagError: the bag cannot be read, or holds no run.
        ds_sim.registry.UntrustedSimulatorError: the bag names a simulator that is not shipped.
        ds_sim.registry.UnknownSimulatorError: the simulator cannot be created.
    """
    with BagReader(folder) as bag:
        recorded = read_run(bag, simulator=simulator, seed=seed, trusted=trusted)
        chosen = simulator or recorded.simulator
        # Another simulator renders other images: compare the states only.
        images = _images(bag, recorded) if chosen == recorded.simulator else iter(())
        frames, compared, step = 0, 0, 0
        try:
            for step, observation in enumerate(resimulate(chosen, recorded.run)):
                recorded_image = next(images, None)
                if recorded_image is not None:
                    if difference := _image_difference(bag, observation, recorded_image):
                        raise ResimulationError(chosen, step, difference)
                    compared += 1
                frames += 1
        except ResimulationError as error:
            return Verification(
                simulator=chosen, frames=frames, images=compared, step=error.step, difference=error.difference
            )
    return Verification(simulator=chosen, frames=frames, images=compared)


def _images(bag: BagReader, recorded: RecordedRun) -> Iterator[Any]:
    """Yield the image of each state, or None; reads images lazily."""
    cameras = [
        connection
        for connection in bag.connections
        if connection.msgtype in (IMAGE, COMPRESSED) and connection.topic.startswith(f"{recorded.namespace}/camera/")
    ]
    messages = (message for _, _, message in bag.decoded(cameras))
    image = next(messages, None)
    for stamp in recorded.stamps:
        while image is not None and stamp_of(image) < stamp:
            image = next(messages, None)
        yield image if image is not None and stamp_of(image) == stamp else None


def _image_difference(bag: BagReader, observation: Observation, recorded: Any) -> str:
    """Describe the difference between two images, or return "" if they are equal; JPEGs are compared as files."""
    try:
        if hasattr(recorded, "format"):
            from ds_sim.camera.encodings import jpeg

            return "" if jpeg(observation.image) == recorded.data.tobytes() else "where the JPEG image differs"
        shape = (recorded.height, recorded.width, 3)
        if shape != observation.image.shape or recorded.encoding != "rgb8":
            size = f"{printable(recorded.width)} x {printable(recorded.height)} px"
            return f"where the recorded image has {size} and encoding {printable(recorded.encoding)}"
        difference = np.abs(recorded.data.reshape(shape).astype(np.int16) - observation.image.astype(np.int16))
    except (AttributeError, TypeError, ValueError) as error:
        raise BagError(f"{bag.path} has a malformed image ({printable(error)}): copy the bag again") from None
    if not difference.any():
        return ""
    pixels = int(difference.any(axis=2).sum())
    return f"where {pixels} pixels of the image differ, by up to {int(difference.max())} levels"
