"""Whether a bag's run comes out the same: states to the last bit, and images if the bag has them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ds_bags.reader import BagReader, RecordedRun, read_run, stamp_of
from ds_sim.resimulation import ResimulationError, resimulate
from ds_sim.simulator import Observation

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"


@dataclass(frozen=True, kw_only=True)
class Verification:
    """What came out.

    Attributes:
        simulator: on which it was driven again.
        frames: that are the same.
        images: how many images were compared.
        step: the first that differs, or None.
        difference: at that step, in words.
    """

    simulator: str
    frames: int
    images: int
    step: int | None = None
    difference: str = ""


def verify_bag(folder: Path, simulator: str | None = None) -> Verification:
    """Drive a bag's commands again and compare.

    Args:
        folder: a bag of ours.
        simulator: another one than the recorded, or None.

    Raises:
        ds_bags.layout.BagError: it cannot be read, or is no bag of ours.
    """
    with BagReader(folder) as bag:
        recorded = read_run(bag)
        chosen = simulator or recorded.simulator
        # Another simulator shows another world: there the states alone can be the same.
        images = _images(bag, recorded) if chosen == recorded.simulator else iter(())
        frames, compared, step = 0, 0, 0
        try:
            for step, seen in enumerate(resimulate(chosen, recorded.run)):
                kept = next(images, None)
                if kept is not None:
                    if difference := _image_difference(seen, kept):
                        raise ResimulationError(chosen, step, difference)
                    compared += 1
                frames += 1
        except ResimulationError as error:
            return Verification(
                simulator=chosen, frames=frames, images=compared, step=error.step, difference=error.difference
            )
    return Verification(simulator=chosen, frames=frames, images=compared)


def _images(bag: BagReader, recorded: RecordedRun) -> Iterator[Any]:
    """For each state its image, or None where there is none; nothing is read ahead of what is asked for."""
    cameras = [
        connection
        for connection in bag.connections
        if connection.msgtype in (IMAGE, COMPRESSED) and connection.topic.startswith(f"{recorded.namespace}/camera/")
    ]
    found = (bag.message(connection, raw) for connection, _, raw in bag.messages(cameras))
    image = next(found, None)
    for stamp in recorded.stamps:
        while image is not None and stamp_of(image) < stamp:
            image = next(found, None)
        yield image if image is not None and stamp_of(image) == stamp else None


def _image_difference(seen: Observation, kept: Any) -> str:
    """In words, or "" if the recorded image is the one that is seen now; JPEG is made again to compare."""
    if hasattr(kept, "format"):
        from ds_sim.camera.jpeg import encode

        return "" if encode(seen.image) == kept.data.tobytes() else "where the image is another, by its JPEG"
    shape = (kept.height, kept.width, 3)
    if shape != seen.image.shape or kept.encoding != "rgb8":
        return f"where the image is {kept.width} x {kept.height} {kept.encoding}"
    apart = np.abs(kept.data.reshape(shape).astype(np.int16) - seen.image.astype(np.int16))
    if not apart.any():
        return ""
    return f"where {int(apart.any(axis=2).sum())} pixels of the image differ, by up to {int(apart.max())} levels"
