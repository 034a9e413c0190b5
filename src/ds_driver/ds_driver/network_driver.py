"""A driver that steers by a network and keeps its speed by the paper's equation 2."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray

from ds_driver.control import throttle
from ds_driver.preprocessing import Crop, prepare
from ds_driver.weights import load_network
from ds_sim.camera_spec import IMAGE_HEIGHT, IMAGE_WIDTH
from ds_sim.simulator import Command


class NetworkDriver:
    """Images and speed in, commands out; the same bits for the same image in any process.

    Args:
        network: a shipped network's name or a weights file.

    Raises:
        ds_driver.weights.WeightsError: the weights cannot be used.
        ds_driver.networks.UnknownNetworkError: the name stands for nothing.
    """

    def __init__(self, network: str) -> None:
        torch.set_num_threads(1)
        self._network = load_network(network).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.command(np.zeros((IMAGE_HEIGHT, IMAGE_WIDTH, 3), np.uint8), 0.0, Crop())

    @torch.inference_mode()
    def steering(self, image: NDArray[np.uint8], crop: Crop) -> float:
        """Steering in [-1, 1] for one camera image, (160, 320, 3) uint8 RGB.

        Raises:
            ds_driver.preprocessing.ImageError: an image of another size or type.
        """
        pixels = torch.from_numpy(prepare(image, crop)).permute(2, 0, 1)[None]
        value = float(self._network(pixels.float()))
        if not math.isfinite(value):
            raise ValueError("the network's steering is not a finite number: its weights are damaged")
        return min(max(value, -1.0), 1.0)

    def command(self, image: NDArray[np.uint8], speed: float, crop: Crop) -> Command:
        """What to do on seeing an image at a speed in m/s."""
        steering = self.steering(image, crop)
        return Command(steering, throttle(steering, speed))
