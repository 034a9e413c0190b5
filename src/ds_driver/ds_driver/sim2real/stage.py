"""Shows a network pseudo-real images: translates each frame before the network sees it (paper 3.2.2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ds_driver.networks.images import Crop, checked
from ds_driver.networks.pilot import NOT_SIMULATED, DriverError, Frame, Pilot, Prediction
from ds_driver.sim2real.generator_set import GeneratorSet
from ds_driver.sim2real.translator import Translator


class Sim2RealStage:
    """Translates camera images of several simulators, each with its own generator.

    Args:
        generators: generators by simulator.
        backend: one of `ds_driver.sim2real.translator.BACKENDS`.
        device: `cpu`, or `cuda` with PyTorch.
    """

    def __init__(self, generators: GeneratorSet, backend: str = "onnx", device: str = "cpu") -> None:
        self.generators = generators
        self._backend, self._device = backend, device
        self._translators: dict[str, Translator] = {}

    def translate(self, image: NDArray[np.uint8], simulator: str) -> NDArray[np.uint8]:
        """Translate one camera image, (160, 320, 3) uint8 RGB; the result is not to be cropped.

        Raises:
            ds_driver.networks.images.ImageError: the image has another size or type.
            DriverError: there is no generator for the simulator.
        """
        return self._translator(simulator).translate(checked(image))

    def seen(self, frames: Sequence[Frame]) -> list[Frame]:
        """Return frames as the network sees them, with the bits of `translate`; frames of one simulator in one batch.

        Raises:
            ds_driver.networks.images.ImageError: an image has another size or type.
            DriverError: there is no generator for a frame, or the frame does not name its simulator.
        """
        places: dict[str, list[int]] = {}
        for index, frame in enumerate(frames):
            if frame.simulator is None:
                raise DriverError("the network sees translated images, but the frame does not name its simulator")
            places.setdefault(frame.simulator, []).append(index)
        found = list(frames)
        for simulator, indices in places.items():
            if simulator == NOT_SIMULATED:
                continue
            images = self._translator(simulator).translate_all([checked(frames[i].image) for i in indices])
            for index, image in zip(indices, images, strict=True):
                found[index] = replace(frames[index], image=image, crop=Crop(), simulator=NOT_SIMULATED)
        return found

    def rows_seen(self, simulator: str) -> tuple[int, int]:
        """Return first row and end of the rows that the generator of a simulator looks at."""
        window = self.generators.generator(simulator).window
        return window.top, window.bottom

    def _translator(self, simulator: str) -> Translator:
        if simulator not in self._translators:
            generator = self.generators.generator(simulator)
            self._translators[simulator] = Translator(generator, self._backend, self._device)
        return self._translators[simulator]


class TranslatingPilot(Pilot):
    """Drives with a network that sees translated images."""

    def __init__(self, pilot: Pilot, stage: Sim2RealStage) -> None:
        self._pilot = pilot
        self.stage = stage
        self.largest_batch = pilot.largest_batch

    def start(self) -> None:
        """See `ds_driver.networks.pilot.Pilot`."""
        self._pilot.start()

    def predict(self, frame: Frame) -> Prediction:
        """See `ds_driver.networks.pilot.Pilot`."""
        return self._pilot.predict(self.stage.seen([frame])[0])

    def predict_batch(self, frames: Sequence[Frame]) -> list[Prediction | DriverError]:
        """See `ds_driver.networks.pilot.Pilot`."""
        try:
            seen = self.stage.seen(frames)
        except DriverError:  # of one frame; the others are answered
            return super().predict_batch(frames)
        return self._pilot.predict_batch(seen)

    def rows_seen(self, crop: Crop, height: int, simulator: str | None) -> tuple[int, int] | None:
        """See `ds_driver.networks.pilot.Pilot`."""
        if simulator == NOT_SIMULATED:
            return self._pilot.rows_seen(crop, height, simulator)
        if simulator is None or simulator not in self.stage.generators:
            return None
        return self.stage.rows_seen(simulator)
