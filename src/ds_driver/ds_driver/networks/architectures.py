"""The driving networks (paper 4.1.1): an image in, a steering angle out."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor, nn


class UnknownNetworkError(ValueError):
    """A name that stands for no network."""


class Dave2(nn.Module):
    """Nvidia's Dave-2 as the paper uses it: five convolutions and three dense layers, 2,882,619 parameters.

    Input (n, 3, 160, 320) YUV in 0 to 255; output (n, 1), steering with -1 full left and +1 full right.
    """

    def __init__(self) -> None:
        super().__init__()
        self.features = nn.Sequential(
            nn.Conv2d(3, 24, 5, stride=2), nn.ELU(),
            nn.Conv2d(24, 36, 5, stride=2), nn.ELU(),
            nn.Conv2d(36, 48, 5, stride=2), nn.ELU(),
            nn.Conv2d(48, 64, 3), nn.ELU(),
            nn.Conv2d(64, 64, 3), nn.ELU(),
            nn.Dropout(0.5),
        )  # fmt: skip
        self.steering = nn.Sequential(
            nn.Flatten(),
            nn.Linear(27456, 100), nn.ELU(),
            nn.Linear(100, 50), nn.ELU(),
            nn.Linear(50, 10), nn.ELU(),
            nn.Linear(10, 1),
        )  # fmt: skip

    def forward(self, image: Tensor) -> Tensor:
        """Steering for a batch of images."""
        result: Tensor = self.steering(self.features(image / 127.5 - 1.0))
        return result


class DropoutAheadOfMaximum(nn.Dropout):
    """Dropout for an input of max pooling: what is kept keeps its size.

    The usual one enlarges what it keeps by 1 / (1 - p), for a sum to come out right. A maximum over neighbours that
    hardly differ comes out too large by the same factor, which is missing when the network drives: after Chauffeur's
    five blocks its features are 0.95^5 = 0.77 of what it was trained with, and so is its steering.
    """

    def forward(self, values: Tensor) -> Tensor:
        """The values, in training each of them 0 with probability `p`."""
        return super().forward(values).mul_(1.0 - self.p) if self.training else values


class Chauffeur(nn.Module):
    """Chauffeur, of Udacity's second challenge, as the paper uses it: six convolutions, 104,905 parameters.

    Input and output as those of `Dave2`.
    """

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        channels = 3
        # Filters and kernel sizes (maxitwo); each block halves the image.
        for filters, kernel in ((16, 5), (20, 5), (40, 3), (60, 3), (80, 2)):
            layers += [_same(channels, filters, kernel), nn.ReLU(), DropoutAheadOfMaximum(0.05), nn.MaxPool2d(2)]
            channels = filters
        self.features = nn.Sequential(*layers, _same(channels, 128, 2), nn.ReLU())
        # maxitwo's signature says 0.1, but its training passes 0.5.
        self.steering = nn.Sequential(nn.Flatten(), nn.Dropout(0.5), nn.Linear(6400, 1))
        for layer in self.features.modules():
            if isinstance(layer, nn.Conv2d):
                nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")

    def forward(self, image: Tensor) -> Tensor:
        """Steering for a batch of images."""
        result: Tensor = self.steering(self.features(image / 127.5 - 1.0))
        return result


class Epoch(nn.Module):
    """Epoch, of Udacity's second challenge, reduced as in the paper: three convolutions, 26,239,009 parameters.

    Input and output as those of `Dave2`.
    """

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        channels = 3
        for filters in (16, 32, 64):
            layers += [_same(channels, filters, 3), nn.ReLU(), nn.MaxPool2d(2), nn.Dropout(0.1)]
            channels = filters
        self.features = nn.Sequential(*layers)
        self.steering = nn.Sequential(
            nn.Flatten(),
            nn.Linear(51200, 512), nn.ReLU(), nn.Dropout(0.5),
            nn.Linear(512, 1),
        )  # fmt: skip

    def forward(self, image: Tensor) -> Tensor:
        """Steering for a batch of images."""
        result: Tensor = self.steering(self.features(image / 127.5 - 1.0))
        return result


def _same(channels: int, filters: int, kernel: int) -> nn.Module:
    """A convolution that keeps the image's size; an even kernel pads right and below, as Keras does."""
    if kernel % 2:
        return nn.Conv2d(channels, filters, kernel, padding=kernel // 2)
    return nn.Sequential(nn.ZeroPad2d((0, 1, 0, 1)), nn.Conv2d(channels, filters, kernel))


NETWORKS: dict[str, Callable[[], nn.Module]] = {"dave2": Dave2, "chauffeur": Chauffeur, "epoch": Epoch}
"""Name on the command line -> architecture."""


def make_network(name: str) -> nn.Module:
    """Make an untrained network.

    Raises:
        UnknownNetworkError: no network has this name.
    """
    if name not in NETWORKS:
        raise UnknownNetworkError(f"unknown network {name!r}: expected one of {', '.join(NETWORKS)}, or a weights file")
    return NETWORKS[name]()


def count_parameters(network: nn.Module) -> int:
    """Trainable parameters."""
    return sum(p.numel() for p in network.parameters() if p.requires_grad)
