# SPDX-License-Identifier: Apache-2.0
"""Generators and discriminators of CycleGAN, and their pool of earlier translations (Zhu et al. 2017, 4 and 7.1)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from ds_driver.networks.backends import Runner
from ds_driver.networks.torch_networks import replayed, torch_device, torch_runner
from ds_driver.sim2real.generator import EPSILON, GeneratorShape, StoredGenerator

INITIAL_DEVIATION = 0.02
"""Standard deviation of the initial weights (Zhu et al. 2017, section 7.1)."""


class InstanceNorm(nn.Module):
    """Normalises each channel of each image; (n, channels, rows, columns)."""

    def forward(self, values: Tensor) -> Tensor:
        """Return values of mean 0 and variance 1."""
        if len(values) == 1:  # keeps the memory format: a training step takes a fifth less time
            return functional.batch_norm(values, None, None, training=True, eps=EPSILON)
        return functional.instance_norm(values, eps=EPSILON)


class ResidualBlock(nn.Module):
    """Adds two convolutions of its input to the input; (n, channels, rows, columns)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.body = nn.Sequential(
            nn.ReflectionPad2d(1),
            nn.Conv2d(channels, channels, 3),
            InstanceNorm(),
            nn.ReLU(inplace=True),
            nn.ReflectionPad2d(1),
            nn.Conv2d(channels, channels, 3),
            InstanceNorm(),
        )

    def forward(self, values: Tensor) -> Tensor:
        """Return the sum."""
        return values + self.body(values)


class Generator(nn.Module):
    """Translates images from one domain to the other: (n, 3, rows, columns) RGB in -1 to 1 both ways."""

    def __init__(self, shape: GeneratorShape) -> None:
        super().__init__()
        filters = shape.filters
        begin = nn.ReflectionPad2d(3), nn.Conv2d(3, filters, 7)
        layers: list[nn.Module] = [*begin, InstanceNorm(), nn.ReLU(inplace=True)]
        for channels in (filters, 2 * filters):
            down = nn.Conv2d(channels, 2 * channels, 3, stride=2, padding=1)
            layers += [down, InstanceNorm(), nn.ReLU(inplace=True)]
        layers += [ResidualBlock(4 * filters) for _ in range(shape.blocks)]
        for channels in (4 * filters, 2 * filters):
            up = nn.ConvTranspose2d(channels, channels // 2, 3, stride=2, padding=1, output_padding=1)
            layers += [up, InstanceNorm(), nn.ReLU(inplace=True)]
        layers += [nn.ReflectionPad2d(3), nn.Conv2d(filters, 3, 7), nn.Tanh()]
        self.layers = nn.Sequential(*layers)
        initialise(self)

    def forward(self, image: Tensor) -> Tensor:
        """Translate a batch of images."""
        result: Tensor = self.layers(image)
        return result


class Discriminator(nn.Module):
    """Judges overlapping patches (PatchGAN); (n, 3, rows, columns) to (n, 1, ...), 1 for real.

    Of its layers, with `filters` channels in the first, `depth` halve the image: 3 judge patches of 70 x 70 pixels (Zhu
    et al. 2017), 2 of 34 x 34.
    """

    def __init__(self, filters: int, depth: int = 3) -> None:
        super().__init__()
        layers: list[nn.Module] = [nn.Conv2d(3, filters, 4, stride=2, padding=1), nn.LeakyReLU(0.2, inplace=True)]
        for layer in range(1, depth + 1):
            channels = filters * 2 ** (layer - 1)
            layers += [
                nn.Conv2d(channels, 2 * channels, 4, stride=2 if layer < depth else 1, padding=1),
                InstanceNorm(),
                nn.LeakyReLU(0.2, inplace=True),
            ]
        self.layers = nn.Sequential(*layers, nn.Conv2d(filters * 2**depth, 1, 4, padding=1))
        initialise(self)

    def forward(self, image: Tensor) -> Tensor:
        """Judge a batch of images."""
        result: Tensor = self.layers(image)
        return result


def initialise(network: nn.Module) -> None:
    """Draw normal weights from PyTorch's generator, and set biases to 0."""
    for layer in network.modules():
        if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d):
            nn.init.normal_(layer.weight, 0.0, INITIAL_DEVIATION)
            assert layer.bias is not None
            nn.init.zeros_(layer.bias)


def to_batch(images: Tensor) -> Tensor:
    """Convert (n, rows, columns, 3) uint8 RGB to the networks' input, (n, 3, rows, columns) in -1 to 1."""
    return (images.permute(0, 3, 1, 2).float() / 127.5 - 1.0).contiguous(memory_format=torch.channels_last)


def to_images(batch: Tensor) -> Tensor:
    """Convert what a generator returns to (n, rows, columns, 3) uint8 RGB."""
    return ((batch.float() + 1.0) * 127.5).round().clamp(0, 255).to(torch.uint8).permute(0, 2, 3, 1).contiguous()


def generator_runner(generator: StoredGenerator, device: str) -> Runner:
    """Run a stored generator on prepared images, (n, rows, columns, 3) uint8 RGB."""
    where, network = torch_device(device), Generator(generator.shape)
    network.load_state_dict({name: torch.from_numpy(value) for name, value in generator.tensors.items()})
    network = network.eval().to(memory_format=torch.channels_last).to(where)  # type: ignore[call-overload]
    return torch_runner(replayed(lambda images: to_images(network(to_batch(images))), where), where)


class ImagePool:
    """Keeps up to `size` images; a full pool returns an earlier one half of the time, and keeps the new one instead."""

    def __init__(self, size: int) -> None:
        self.size = size
        self.images: list[Tensor] = []

    def query(self, image: Tensor, rng: np.random.Generator) -> Tensor:
        """Return the image itself, (1, 3, rows, columns) without gradient, or an earlier one in exchange."""
        if len(self.images) < self.size:
            self.images.append(image)
            return image
        if not self.images or rng.random() < 0.5:
            return image
        index = int(rng.integers(len(self.images)))
        earlier, self.images[index] = self.images[index], image
        return earlier

    def state(self) -> Tensor:
        """Return the images as one tensor, for a checkpoint."""
        return torch.cat(self.images).cpu() if self.images else torch.zeros(0)

    def restore(self, state: Tensor, device: torch.device) -> None:
        """Take the images of a checkpoint."""
        self.images = [image.contiguous(memory_format=torch.channels_last) for image in state.to(device).split(1)]
