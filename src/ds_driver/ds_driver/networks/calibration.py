# SPDX-License-Identifier: Apache-2.0
"""Shipped camera images by which networks are quantised; `benchmarks/calibration_frames.py` makes them."""

from __future__ import annotations

from ds_base.bounded_file import read_regular
from ds_base.bounded_json import read_json
from ds_driver.networks.images import Crop, rgb_of_file
from ds_driver.networks.pilot import Frame
from ds_driver.networks.weights import SHIPPED
from ds_sim.camera.spec import IMAGE_HEIGHT

FOLDER = SHIPPED / "calibration"
"""One vertical strip of frames per simulator, plus cached crops, because constructing simulators is slow."""


def calibration_frames() -> list[Frame]:
    """Return frames of drives on every shipped simulator, in a fixed order."""
    crops = read_json(FOLDER / "crops.json")
    frames = []
    for name, (top, bottom) in sorted(crops.items()):
        pixels = rgb_of_file(read_regular(FOLDER / f"{name}.jpg"))
        images = pixels.reshape(-1, IMAGE_HEIGHT, *pixels.shape[1:])
        frames += [Frame(image=image, speed=0.0, crop=Crop(top, bottom), simulator=name) for image in images]
    return frames
