# SPDX-License-Identifier: Apache-2.0
"""The driving networks (paper 4.1.1) as tables of layers, for ONNX (`onnx_export`) and PyTorch (`torch_networks`)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import prod

from ds_base.errors import InputError


class UnknownNetworkError(InputError):
    """The name does not denote a network."""


@dataclass(frozen=True, slots=True)
class Conv:
    """Convolution with bias; `same` keeps the image size, and even kernels then pad right and bottom, as in Keras."""

    inputs: int
    filters: int
    kernel: int
    stride: int = 1
    same: bool = False

    @property
    def padding(self) -> tuple[int, int]:
        """Return the rows of zeros above and below the image, which are also the columns left and right of it."""
        return ((self.kernel - 1) // 2, self.kernel // 2) if self.same else (0, 0)


@dataclass(frozen=True, slots=True)
class Dense:
    """Dense layer with bias."""

    inputs: int
    outputs: int


@dataclass(frozen=True, slots=True)
class MaxPool:
    """Maximum over squares of `size` x `size` values that do not overlap."""

    size: int


@dataclass(frozen=True, slots=True)
class Dropout:
    """Sets values to zero with a probability `rate`, only in training; with `rescale` others grow by 1 / (1 - rate).

    That preserves the expected value of a sum, but makes a maximum over nearly equal neighbours too large by that
    factor, and only in training: when driving, the features after Chauffeur's five blocks, and so its steering, would
    be 0.95^5 = 0.77 of those in training.
    """

    rate: float
    rescale: bool = True


@dataclass(frozen=True, slots=True)
class Elementwise:
    """Layer without weights, by the name of its ONNX operator: `Elu`, `Relu` or `Flatten`."""

    kind: str


Layer = Conv | Dense | MaxPool | Dropout | Elementwise
ELU, RELU, FLATTEN = Elementwise("Elu"), Elementwise("Relu"), Elementwise("Flatten")


@dataclass(frozen=True, slots=True)
class Architecture:
    """Network from an image, (n, 3, 160, 320) YUV in 0 to 255, to steering, (n, 1), -1 full left to +1 full right."""

    title: str  # in the literature; also the name of the ONNX graph
    features: tuple[Layer, ...]  # which see the image, scaled to -1 to 1
    steering: tuple[Layer, ...]  # after them
    initialise_for_relu: bool = False  # whether convolutions start with He's weights instead of PyTorch's default

    def layers(self) -> Iterator[tuple[str, Layer]]:
        """Yield all layers in order, each with the prefix of its tensors in a weights file."""
        for part, layers in (("features", self.features), ("steering", self.steering)):
            for index, layer in enumerate(layers):
                # PyTorch pads an even kernel with a layer of its own, in front of the convolution.
                nested = isinstance(layer, Conv) and layer.padding[0] != layer.padding[1]
                yield f"{part}.{index}.1" if nested else f"{part}.{index}", layer

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shape of each tensor of a weights file."""
        shapes: dict[str, tuple[int, ...]] = {}
        for name, layer in self.layers():
            if isinstance(layer, Conv):
                shapes[f"{name}.weight"] = (layer.filters, layer.inputs, layer.kernel, layer.kernel)
                shapes[f"{name}.bias"] = (layer.filters,)
            elif isinstance(layer, Dense):
                shapes[f"{name}.weight"] = (layer.outputs, layer.inputs)
                shapes[f"{name}.bias"] = (layer.outputs,)
        return shapes

    @property
    def parameters(self) -> int:
        """Return the number of trainable parameters."""
        return sum(map(prod, self.shapes().values()))


def _with_elu(*layers: Layer) -> tuple[Layer, ...]:
    return tuple(one for layer in layers for one in (layer, ELU))


def _chauffeur_block(inputs: int, filters: int, kernel: int) -> tuple[Layer, ...]:
    return Conv(inputs, filters, kernel, same=True), RELU, Dropout(0.05, rescale=False), MaxPool(2)


def _epoch_block(inputs: int, filters: int) -> tuple[Layer, ...]:
    return Conv(inputs, filters, 3, same=True), RELU, MaxPool(2), Dropout(0.1)


DAVE2 = Architecture(
    "Dave2",
    features=(
        *_with_elu(Conv(3, 24, 5, stride=2), Conv(24, 36, 5, stride=2), Conv(36, 48, 5, stride=2)),
        *_with_elu(Conv(48, 64, 3), Conv(64, 64, 3)),
        Dropout(0.5),
    ),
    steering=(FLATTEN, *_with_elu(Dense(27456, 100), Dense(100, 50), Dense(50, 10)), Dense(10, 1)),
)
"""Nvidia's Dave-2 as used in the paper: five convolutions and four dense layers, 2,882,619 parameters."""

CHAUFFEUR = Architecture(
    "Chauffeur",
    # Filters and kernel sizes (maxitwo); each block halves the image.
    features=(
        *_chauffeur_block(3, 16, 5),
        *_chauffeur_block(16, 20, 5),
        *_chauffeur_block(20, 40, 3),
        *_chauffeur_block(40, 60, 3),
        *_chauffeur_block(60, 80, 2),
        Conv(80, 128, 2, same=True),
        RELU,
    ),
    # maxitwo's signature defaults to 0.1, but its training passes 0.5.
    steering=(FLATTEN, Dropout(0.5), Dense(6400, 1)),
    initialise_for_relu=True,
)
"""Chauffeur, from Udacity's second challenge, as used in the paper: six convolutions, 104,905 parameters."""

EPOCH = Architecture(
    "Epoch",
    features=(*_epoch_block(3, 16), *_epoch_block(16, 32), *_epoch_block(32, 64)),
    steering=(FLATTEN, Dense(51200, 512), RELU, Dropout(0.5), Dense(512, 1)),
)
"""Epoch, from Udacity's second challenge, reduced as in the paper: three convolutions, 26,239,009 parameters.

Trained with dropout to the end, it steered 0.85 to 0.90 of its labels, and 0.97 to 1.00 with dropout left on, which
makes the mean activation larger. So the laptop schedule leaves out dropout in the last epoch.
"""

NETWORKS = {"dave2": DAVE2, "chauffeur": CHAUFFEUR, "epoch": EPOCH}
"""Name on the command line -> architecture."""
