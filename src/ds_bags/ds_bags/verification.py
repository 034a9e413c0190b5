"""Re-simulates a recorded run and compares it bit by bit: states, and images if the bag has them.

`ds bag redrive` on the command line: the recorded simulator gets the recorded commands again, on the same road and from
the same seed. No driver takes part.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ds_bags.layout import BagError
from ds_bags.limits import printable
from ds_bags.reader import BagReader, RecordedRun, read_run, stamp_of
from ds_sim.resimulation import ResimulationError, resimulate
from ds_sim.simulator import Observation

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"


@dataclass(frozen=True, kw_only=True)
class Verification:
    """Result of a re-simulation.

    Attributes:
        simulator: that re-simulated the run.
        frames: number of frames that came out the same.
        images: number of images that were compared.
        step: first step that differs, or None.
        difference: at that step, in words.
    """

    simulator: str
    frames: int
    images: int
    step: int | None = None
    difference: str = ""


def verify_bag(
    folder: Path, simulator: str | None = None, *, seed: int | None = None, trusted: Collection[str] = ()
) -> Verification:
    """Re-simulate a bag's run and compare.

    Args:
        folder: bag of this project.
        simulator: another one than the recorded, named by the user.
        seed: of the run, if the bag has lost it.
        trusted: simulators of the user's own that the bag may name, see `read_run`.

    Raises:
        ds_bags.layout.BagError: the bag cannot be read, or holds no run.
        ds_sim.registry.UntrustedSimulatorError: the bag names a simulator that is not shipped.
        ds_sim.registry.UnknownSimulatorError: the simulator cannot be made.
    """
    with BagReader(folder) as bag:
        recorded = read_run(bag, simulator=simulator, seed=seed, trusted=trusted)
        chosen = simulator or recorded.simulator
        # Another simulator shows another world: there the states alone can be the same.
        images = _images(bag, recorded) if chosen == recorded.simulator else iter(())
        frames, compared, step = 0, 0, 0
        try:
            for step, seen in enumerate(resimulate(chosen, recorded.run)):
                kept = next(images, None)
                if kept is not None:
                    if difference := _image_difference(bag, seen, kept):
                        raise ResimulationError(chosen, step, difference)
                    compared += 1
                frames += 1
        except ResimulationError as error:
            return Verification(
                simulator=chosen, frames=frames, images=compared, step=error.step, difference=error.difference
            )
    return Verification(simulator=chosen, frames=frames, images=compared)


def _images(bag: BagReader, recorded: RecordedRun) -> Iterator[Any]:
    """Yield for each state its image, or None; images are read as they are needed."""
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


def _image_difference(bag: BagReader, seen: Observation, kept: Any) -> str:
    """Difference in words, or "" if the recorded image is the one that is seen now; a JPEG is compared with a new one.

    Raises:
        BagError: the recorded image is malformed.
    """
    try:
        if hasattr(kept, "format"):
            from ds_sim.camera.jpeg import encode

            return "" if encode(seen.image) == kept.data.tobytes() else "where the image is another, by its JPEG"
        shape = (kept.height, kept.width, 3)
        if shape != seen.image.shape or kept.encoding != "rgb8":
            return f"where the image is {printable(kept.width)} x {printable(kept.height)} {printable(kept.encoding)}"
        apart = np.abs(kept.data.reshape(shape).astype(np.int16) - seen.image.astype(np.int16))
    except (AttributeError, TypeError, ValueError) as error:
        raise BagError(f"{bag.path} has a malformed image ({printable(error)}): copy the bag again") from None
    if not apart.any():
        return ""
    return f"where {int(apart.any(axis=2).sum())} pixels of the image differ, by up to {int(apart.max())} levels"
