# SPDX-License-Identifier: Apache-2.0
"""Common interface of driving networks: a frame in, steering and optionally throttle out."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from ds_base.errors import InputError
from ds_driver.control.bicycle import Geometry
from ds_driver.networks.images import Crop, prepare
from ds_sim.camera.spec import IMAGE_HEIGHT, IMAGE_WIDTH
from ds_sim.simulator import Observation, SimulatorSpec

if TYPE_CHECKING:
    from ds_driver.sim2real.image_translation import GeneratorSet

_Question = TypeVar("_Question")
_Answer = TypeVar("_Answer")
NOT_SIMULATED = ""
"""In place of a simulator's name: a photograph, or an image that is translated already; a network sees it as it is."""


class DriverError(InputError):
    """The driver cannot be loaded or gives no valid answer: the run ends as an error, not as a failure."""


def attempt(answer: Callable[[_Question], _Answer], question: _Question) -> _Answer | DriverError:
    """Return an answer, or the error that a driver gives none."""
    try:
        return answer(question)
    except DriverError as error:
        return error


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """Input of a driver for one frame.

    Attributes:
        image: (160, 320, 3) uint8 RGB, the whole camera image, read-only.
        speed: of the vehicle, m/s.
        crop: rows that the paper's networks do not see on this simulator.
        step: number of frames since the start of the run.
        simulator: whose camera took the image, or `NOT_SIMULATED`; None if unknown, which networks refuse that see
            translated images (`ds_driver.sim2real.image_translation`).
        vehicle: in road metres; None if unknown, which networks refuse that answer angles, curvatures or paths.
    """

    image: NDArray[np.uint8]
    speed: float
    crop: Crop = Crop()
    step: int = 0
    simulator: str | None = None
    vehicle: Geometry | None = None

    @classmethod
    def of(cls, observation: Observation, spec: SimulatorSpec) -> Frame:
        """Return what a driver gets of an observation on a simulator."""
        return cls(
            image=observation.image,
            speed=observation.vehicle.speed,
            crop=Crop.of(spec),
            step=observation.step,
            simulator=spec.name,
            vehicle=Geometry.of(spec),
        )

    @classmethod
    def black(cls) -> Frame:
        """Return a black image of no simulator on some vehicle, by which drivers are tried out and warmed up."""
        image = np.zeros((IMAGE_HEIGHT, IMAGE_WIDTH, 3), np.uint8)
        return cls(image=image, speed=0.0, simulator=NOT_SIMULATED, vehicle=Geometry(2.5, 0.6))


@dataclass(frozen=True, slots=True)
class Prediction:
    """Output of a network.

    Attributes:
        steering: -1 full left to +1 full right; larger values are clipped.
        throttle: 0 to 1, or None for the paper's equation 2.

    Raises:
        DriverError: a value is not a finite number.
    """

    steering: float
    throttle: float | None = None

    def __post_init__(self) -> None:
        for name, value in (("steering", self.steering), ("throttle", self.throttle)):
            if value is not None and not math.isfinite(value):
                raise DriverError(f"the network's {name} is {value}, expected a finite number: check its weights")


class Pilot(ABC):
    """Network that can drive.

    Attributes:
        largest_batch: frames that `predict_batch` takes at once; more than one only if a prediction depends on its
            frame alone, so that frames of several runs may alternate.
        sees_crop_only: whether it never looks at rows outside the crop of a frame.
        has_memory: whether an answer may depend on earlier frames of its run, so that none may be left out.
        translation: of images before the network sees them; None if it sees them as they are.
    """

    largest_batch: int = 1
    sees_crop_only: bool = False
    has_memory: bool = False
    translation: GeneratorSet | None = None

    def start(self) -> None:
        """Reset all state at the start of a run; most networks have none."""
        return

    @abstractmethod
    def predict(self, frame: Frame) -> Prediction:
        """Predict steering and throttle for a frame.

        Raises:
            DriverError: the network gives no valid answer.
            ds_driver.networks.images.ImageError: the image has another size or type.
        """

    def seen(self, frame: Frame) -> tuple[NDArray[np.uint8], str]:
        """Return what it sees of a frame, for pictures: (rows, columns, channels) uint8, and what the channels are.

        Without an override, the image as the paper's networks see it.
        """
        return prepare(frame.image, frame.crop), "yuv"

    def rows_seen(self, crop: Crop, height: int, simulator: str) -> tuple[int, int] | None:
        """Return first row and end of the rows that it looks at in a simulator's images; None if it may look at all.

        The images have `height` rows, of which `crop` is what the paper's networks do not see on this simulator.
        """
        return (crop.top, height - crop.bottom) if self.sees_crop_only else None

    def predict_batch(self, frames: Sequence[Frame]) -> list[Prediction | DriverError]:
        """Predict for several frames: the bits of `predict`, or the error of the frame.

        Raises:
            ds_driver.networks.images.ImageError: an image has another size or type.
        """
        return [attempt(self.predict, frame) for frame in frames]
