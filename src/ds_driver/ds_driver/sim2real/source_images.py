"""Reads some camera images of a simulator from whatever holds them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ds_driver.data.dataset import decode, read_samples
from ds_driver.data.recordings import Reading, open_recording
from ds_driver.sim2real.photographs import SUFFIXES, read_images
from ds_driver.sim2real.window import Sim2RealError
from ds_sim.registry import SIMULATORS


def camera_images(source: Path, simulator: str, count: int) -> list[NDArray[np.uint8]]:
    """Read evenly chosen images of a simulator's camera.

    Args:
        source: data set, bag, tub, or folder of images.
        simulator: simulator whose images they are; checked where the source says so.
        count: largest number of images.

    Raises:
        Sim2RealError: there are none, or they are of another simulator.
    """
    if source.is_dir() and next(source.glob("*/*.parquet"), None) is not None:
        samples = [sample for sample in read_samples(source) if sample.simulator == simulator]
        if not samples:
            raise Sim2RealError(f"{source} has no drives of {simulator}, whose images the generator translates")
        chosen = np.unique(np.linspace(0, len(samples) - 1, min(count, len(samples))).round().astype(int))
        return [decode(samples[i].jpeg) for i in chosen]
    if (source / "metadata.yaml").exists() or source.suffix in (".mcap", ".db3", ".bag"):
        group = open_recording(source, Reading()).group
        if group in SIMULATORS and group != simulator:
            raise Sim2RealError(
                f"the generator translates images of {simulator}, {source} is of {group}: choose the one of {group}"
            )
    images = [image for _, image in read_images(source, count)]
    if not images:
        raise Sim2RealError(f"{source} has no images: expected a data set, a bag, a tub or {', '.join(SUFFIXES)} files")
    return images
