"""Defines the driving networks (paper 4.1.1), which predict steering from an image."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor, nn


class UnknownNetworkError(ValueError):
    """The name does not denote a network."""


class Dave2(nn.Module):
    """Nvidia's Dave-2 as used in the paper: five convolutions and three dense layers, 2,882,619 parameters.

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
        """Predict steering for a batch of images."""
        result: Tensor = self.steering(self.features(image / 127.5 - 1.0))
        return result


class DropoutAheadOfMaximum(nn.Dropout):
    """Dropout without rescaling, for use before max pooling.

    Standard dropout scales the kept values by 1 / (1 - p), which preserves the expected value of a sum. It makes a
    maximum over nearly equal neighbours too large by the same factor, and only in training: when driving, the features
    after Chauffeur's five blocks, and so its steering, would be 0.95^5 = 0.77 of those in training.
    """

    def forward(self, values: Tensor) -> Tensor:
        """Set each value to 0 with probability `p` in training; return the values unchanged otherwise."""
        return super().forward(values).mul_(1.0 - self.p) if self.training else values


class Chauffeur(nn.Module):
    """Chauffeur, from Udacity's second challenge, as used in the paper: six convolutions, 104,905 parameters.

    Input and output as for `Dave2`.
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
        # maxitwo's signature defaults to 0.1, but its training passes 0.5.
        self.steering = nn.Sequential(nn.Flatten(), nn.Dropout(0.5), nn.Linear(6400, 1))
        for layer in self.features.modules():
            if isinstance(layer, nn.Conv2d):
                nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")

    def forward(self, image: Tensor) -> Tensor:
        """Predict steering for a batch of images."""
        result: Tensor = self.steering(self.features(image / 127.5 - 1.0))
        return result


class Epoch(nn.Module):
    """Epoch, from Udacity's second challenge, reduced as in the paper: three convolutions, 26,239,009 parameters.

    Input and output as for `Dave2`.
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
        """Predict steering for a batch of images."""
        result: Tensor = self.steering(self.features(image / 127.5 - 1.0))
        return result


def _same(channels: int, filters: int, kernel: int) -> nn.Module:
    """Make a convolution that keeps the image size; even kernels pad right and bottom, as in Keras."""
    if kernel % 2:
        return nn.Conv2d(channels, filters, kernel, padding=kernel // 2)
    return nn.Sequential(nn.ZeroPad2d((0, 1, 0, 1)), nn.Conv2d(channels, filters, kernel))


NETWORKS: dict[str, Callable[[], nn.Module]] = {"dave2": Dave2, "chauffeur": Chauffeur, "epoch": Epoch}
"""Name on the command line -> architecture."""


def make_network(name: str) -> nn.Module:
    """Create an untrained network.

    Raises:
        UnknownNetworkError: no network has this name.
    """
    if name not in NETWORKS:
        raise UnknownNetworkError(f"unknown network {name!r}: expected one of {', '.join(NETWORKS)}, or a weights file")
    return NETWORKS[name]()


def count_parameters(network: nn.Module) -> int:
    """Count the trainable parameters."""
    return sum(p.numel() for p in network.parameters() if p.requires_grad)
