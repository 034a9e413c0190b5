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


NETWORKS: dict[str, Callable[[], nn.Module]] = {"dave2": Dave2}
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
