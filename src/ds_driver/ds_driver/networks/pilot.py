"""What any network at the wheel comes to, whoever made it: a frame in, steering and perhaps a throttle out."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ds_driver.networks.preprocessing import Crop


class DriverError(ValueError):
    """A driver that cannot be loaded, or that gives no answer to drive by: the run ends as an error, not a failure."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """What a driver may know of a frame.

    Attributes:
        image: (160, 320, 3) uint8 RGB, the whole camera image, read-only.
        speed: of the vehicle, m/s.
        crop: rows that the paper's networks do not see on this simulator.
        step: frames since the start of the run.
    """

    image: NDArray[np.uint8]
    speed: float
    crop: Crop = Crop()
    step: int = 0


@dataclass(frozen=True, slots=True)
class Prediction:
    """What a network says.

    Attributes:
        steering: -1 full left to +1 full right; beyond that it counts as full.
        throttle: 0 to 1, or None for the paper's equation 2.

    Raises:
        DriverError: a value is not a finite number.
    """

    steering: float
    throttle: float | None = None

    def __post_init__(self) -> None:
        for name, value in (("steering", self.steering), ("throttle", self.throttle)):
            if value is not None and not math.isfinite(value):
                raise DriverError(f"the network's {name} is {value}, not a number to drive by: check its weights")


class Pilot(Protocol):
    """A network that is ready to drive."""

    def start(self) -> None:
        """A run begins: forget the last one."""

    def predict(self, seen: Frame) -> Prediction:
        """What to do on a frame.

        Raises:
            DriverError: there is no answer to drive by.
            ds_driver.networks.preprocessing.ImageError: an image of another size or type.
        """
        ...
