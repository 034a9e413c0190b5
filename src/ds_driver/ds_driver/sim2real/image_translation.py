# SPDX-License-Identifier: Apache-2.0
"""Shows a network pseudo-real images (paper 3.2.2): finds a driver's generators, and translates each frame."""

from __future__ import annotations

import hashlib
import warnings
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ds_base.bounded_file import sha256_of
from ds_driver.networks.backends import graph_runner
from ds_driver.networks.images import Crop, checked
from ds_driver.networks.onnx_export import generator_to_onnx
from ds_driver.networks.pilot import NOT_SIMULATED, DriverError, Frame, Pilot, Prediction
from ds_driver.networks.weights import GENERATORS, path_of_weights, shipped_sets
from ds_driver.sim2real.generator import (
    LARGEST_FILE,
    Sim2RealError,
    StoredGenerator,
    generator_input,
    load_generator,
    resize,
)
from ds_sim.camera.spec import IMAGE_HEIGHT, IMAGE_WIDTH
from ds_sim.registry import SIMULATORS, label_of

Computed = tuple[str, str]
"""Backend and device."""
BACKENDS = ("onnx", "openvino", "openvino-bf16", "torch")


class Translator:
    """Translates images: with the same bits alone and in any batch, and a grey level or so apart on other `BACKENDS`.

    Raises:
        Sim2RealError: the backend is unknown.
        ds_driver.networks.backends.BackendError: the backend is not installed.
    """

    def __init__(self, generator: StoredGenerator, backend: str = "onnx", device: str = "cpu") -> None:
        if backend not in BACKENDS:
            raise Sim2RealError(f"unknown backend {backend!r}: expected one of {', '.join(BACKENDS)}")
        self.generator = generator
        self.backend = backend
        if backend == "torch":
            # PyTorch takes 2 s and 200 MB to import.
            from ds_driver.sim2real.networks import generator_runner

            self._runner = generator_runner(generator, device)
        else:
            self._runner = graph_runner(generator_to_onnx(generator), "the generator", backend)

    def translate(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Translate a camera image, (160, 320, 3) uint8 RGB, to one of that shape that is not to be cropped again.

        Raises:
            Sim2RealError: the image has another size than the camera of the generator's simulator.
        """
        return self.translate_all([image])[0]

    def translate_all(self, images: Sequence[NDArray[np.uint8]]) -> list[NDArray[np.uint8]]:
        """Translate camera images, as many at once as the backend takes; see `translate`."""
        for image in images:
            if image.shape != (IMAGE_HEIGHT, IMAGE_WIDTH, 3):
                raise Sim2RealError(
                    f"image of shape {image.shape}, expected ({IMAGE_HEIGHT}, {IMAGE_WIDTH}, 3): the generator "
                    "translates camera images of simulators"
                )
        window, shape, size = self.generator.window, self.generator.shape.size, self._runner.largest_batch
        prepared = [generator_input(image, window, shape) for image in images]
        parts = (np.stack(prepared[begin : begin + size]) for begin in range(0, len(prepared), size))
        translated = (image for part in parts for image in self._runner.compute(part)[0].astype(np.uint8))
        return [resize(image, (IMAGE_HEIGHT, IMAGE_WIDTH)) for image in translated]


class GeneratorSet:
    """Generators by the labels of their simulators, loaded when first needed, each for the images of its simulator.

    `digests`, simulator -> SHA-256, are those of the files where they are known.
    """

    def __init__(self, name: str, files: Mapping[str, Path], digests: Mapping[str, str], computed: Computed) -> None:
        self.name = name
        self.files = dict(sorted(files.items()))
        self._digests = digests
        self._loaded: dict[str, StoredGenerator] = {}
        self._translator = cache(lambda simulator: Translator(self.generator(simulator), *computed))

    @property
    def generators(self) -> GeneratorSet:
        """Deprecated, goes in 0.5: itself."""
        warnings.warn("generators goes in 0.5: the translation is the set itself", DeprecationWarning, stacklevel=2)
        return self

    def __contains__(self, simulator: str) -> bool:
        return label_of(simulator) in self.files

    def generator(self, simulator: str) -> StoredGenerator:
        """Return the generator for a simulator's images; a DriverError if it is missing, damaged, or another's."""
        label = label_of(simulator)
        if label not in self._loaded:
            if label not in self.files:
                names = f"those of {', '.join(self.files)}" if self.files else "none"
                raise DriverError(
                    f"{self.name} has no generator for images of {simulator}, it has {names}: train one with `ds "
                    f"sim2real train --sim {simulator}`, or leave out {simulator}"
                )
            path = self.files[label]
            try:
                generator = load_generator(path)
            except Sim2RealError as error:
                raise DriverError(str(error)) from None
            if generator.simulator != simulator:
                raise DriverError(f"{path} translates images of {generator.simulator}, not of {simulator}: rename it")
            if generator.window.bottom > IMAGE_HEIGHT or generator.window.right > IMAGE_WIDTH:
                raise DriverError(f"{path} has a crop, {generator.window}, beyond the image: train the generator again")
            if self._digests and generator.sha256 != self._digests.get(simulator):
                raise DriverError(f"{path} has changed: put back the generator that {self.name} was trained with")
            self._loaded[label] = generator
        return self._loaded[label]

    def translate(self, image: NDArray[np.uint8], simulator: str) -> NDArray[np.uint8]:
        """Translate one camera image, (160, 320, 3) uint8 RGB, which is not to be cropped then; or a ValueError."""
        return self._translator(simulator).translate(checked(image))

    def seen(self, frames: Sequence[Frame]) -> list[Frame]:
        """Return frames as the network sees them, with the bits of `translate`; those of one simulator in one batch."""
        places = defaultdict[str, list[int]](list)
        for index, frame in enumerate(frames):
            if frame.simulator is None:
                raise DriverError("the network sees translated images, but the frame does not name its simulator")
            if frame.simulator != NOT_SIMULATED:
                places[frame.simulator].append(index)
        translated = list(frames)
        for simulator, indices in places.items():
            images = self._translator(simulator).translate_all([checked(frames[i].image) for i in indices])
            for index, image in zip(indices, images, strict=True):
                translated[index] = replace(frames[index], image=image, crop=Crop(), simulator=NOT_SIMULATED)
        return translated

    @property
    def sha256(self) -> str:
        """Digest of all files."""
        lines = "".join(f"{label} {_sha256(path)}\n" for label, path in self.files.items())
        return hashlib.sha256(lines.encode()).hexdigest()


def open_set(name: str, computed: Computed = ("onnx", "cpu")) -> GeneratorSet:
    """Open a shipped set by name, or a folder with a `SIMULATOR.safetensors` for each; or a DriverError."""
    sets = shipped_sets()
    files = _files_in(sets.get(name, Path(name)))
    if not files:
        shipped = f"a shipped one ({', '.join(sets)}), or " if sets else ""
        raise DriverError(
            f"no generators in {name!r}: expected {shipped}a folder with files such as {next(iter(SIMULATORS))}"
            ".safetensors, checkpoints of `ds sim2real train`"
        )
    return GeneratorSet(name, files, {}, computed)


def set_of_network(name: str, digests: Mapping[str, str], computed: Computed) -> GeneratorSet:
    """Find the generators, simulator -> SHA-256, beside a network or shipped; a DriverError if one is missing."""
    beside = path_of_weights(name).parent / GENERATORS
    places = [beside, *sorted(path for path in beside.glob("*") if path.is_dir()), *shipped_sets().values()]
    files: dict[str, Path] = {}
    for simulator, digest in digests.items():
        label = label_of(simulator)
        candidates = (_files_in(place).get(label) for place in dict.fromkeys(places))
        match = next((path for path in candidates if path is not None and _sha256(path) == digest), None)
        if match is None:
            raise DriverError(
                f"{name} was trained on images of {simulator} that a generator translated, which is missing: copy it "
                f"to {beside}/{label}.safetensors"
            )
        files[label] = match
    return GeneratorSet(name, files, digests, computed)


def _files_in(folder: Path) -> dict[str, Path]:
    return {path.stem: path for path in sorted(folder.glob("*.safetensors"))} if folder.is_dir() else {}


def _sha256(path: Path) -> str:
    if path.stat().st_size > LARGEST_FILE:
        raise DriverError(f"{path} has more than {LARGEST_FILE // 2**20} MiB: expected a generator")
    return sha256_of([path])


class TranslatingPilot(Pilot):
    """Drives with a network that sees translated images."""

    def __init__(self, pilot: Pilot, translation: GeneratorSet) -> None:
        self._pilot = pilot
        self.translation: GeneratorSet = translation
        self.largest_batch, self.has_memory = pilot.largest_batch, pilot.has_memory

    def start(self) -> None:
        """See `ds_driver.networks.pilot.Pilot`."""
        self._pilot.start()

    def predict(self, frame: Frame) -> Prediction:
        """See `ds_driver.networks.pilot.Pilot`."""
        return self._pilot.predict(self.translation.seen([frame])[0])

    def predict_batch(self, frames: Sequence[Frame]) -> list[Prediction | DriverError]:
        """See `ds_driver.networks.pilot.Pilot`."""
        try:
            translated = self.translation.seen(frames)
        except DriverError:  # of one frame; the others are answered
            return super().predict_batch(frames)
        return self._pilot.predict_batch(translated)

    def seen(self, frame: Frame) -> tuple[NDArray[np.uint8], str]:
        """Return what the network sees of the translated frame; see `Pilot.seen`."""
        return self._pilot.seen(self.translation.seen([frame])[0])

    def rows_seen(self, crop: Crop, height: int, simulator: str) -> tuple[int, int] | None:
        """See `ds_driver.networks.pilot.Pilot`."""
        if simulator not in self.translation:
            return None
        window = self.translation.generator(simulator).window
        return window.top, window.bottom
