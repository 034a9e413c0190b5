# SPDX-License-Identifier: Apache-2.0
"""Drives with a network, built in or user-provided, and controls speed by the paper's equation 2."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable, Sequence
from functools import cache
from importlib import import_module
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ds_base.bounded_file import sha256_of
from ds_base.extension import installed
from ds_base.installation import ds_command
from ds_base.words import did_you_mean
from ds_driver.control.autopilot import throttle
from ds_driver.networks.architectures import NETWORKS, UnknownNetworkError
from ds_driver.networks.backends import default_backend, graph_runner, last_line
from ds_driver.networks.described_network import DescribedNetworkPilot
from ds_driver.networks.description import file_of, read_description
from ds_driver.networks.driver_name import AUTOPILOT, NO_GENERATORS, DriverName
from ds_driver.networks.images import Crop, checked, prepare
from ds_driver.networks.network_file import KINDS, refuse_foreign
from ds_driver.networks.onnx_export import to_onnx
from ds_driver.networks.pilot import DriverError, Frame, Pilot, Prediction, attempt
from ds_driver.networks.weights import Weights, generators_in, load_weights, shipped_networks, weights_sha256
from ds_driver.sim2real.image_translation import GeneratorSet, TranslatingPilot, open_set, set_of_network
from ds_sim.registry import spec_of
from ds_sim.simulator import Command

BACKEND_BEFORE = "onnx"
"""Back end of `auto` in records that do not name it: those of versions before OpenVINO."""


class BuiltInPilot(Pilot):
    """Drives with one of the paper's networks; a BackendError if the backend or the device is not available."""

    sees_crop_only = True

    def __init__(self, weights: Weights, backend: str = "auto", device: str = "cpu") -> None:
        if backend == "torch":
            # PyTorch takes 2 s and 200 MB to import.
            from ds_driver.networks.torch_networks import network_runner

            runner = network_runner(weights, device)
        else:
            runner = graph_runner(to_onnx(weights), weights.name, backend)
        self._compute = runner.compute
        self.largest_batch = runner.largest_batch

    def predict(self, frame: Frame) -> Prediction:
        """See `ds_driver.networks.pilot.Pilot`."""
        return Prediction(float(self._compute(prepare(frame.image, frame.crop)[None])[0].reshape(-1)[0]))

    def predict_batch(self, frames: Sequence[Frame]) -> list[Prediction | DriverError]:
        """See `ds_driver.networks.pilot.Pilot`."""
        if self.largest_batch == 1 or len(frames) < 2:
            return super().predict_batch(frames)
        images = np.stack([prepare(frame.image, frame.crop) for frame in frames])
        try:
            steering = self._compute(images)[0].reshape(-1)
        except DriverError:
            return super().predict_batch(frames)
        return [attempt(Prediction, float(value)) for value in steering]


class UserClassPilot(Pilot):
    """Wraps a class without constructor arguments, with a method `drive(frame)` and, if it has state, `start()`.

    `drive` takes a `Frame` and returns the steering, or a pair of steering and throttle. A class that cannot be made,
    or fails on a black image, is a DriverError.
    """

    def __init__(self, target: str) -> None:
        kind, self._target = _find(target), target
        try:
            self._driver: Any = kind()
        except Exception as error:
            raise DriverError(f"driver {target} cannot be created ({_describe(error)}): fix its __init__") from None
        if not callable(getattr(self._driver, "drive", None)):
            raise DriverError(f"driver {target} has no method drive(frame): see docs/bring_your_own_network.md")
        self.has_memory = getattr(self._driver, "start", None) is not None
        self.start()
        self.predict(Frame.black())
        self.start()

    def start(self) -> None:
        """Call `start` of the class, if it has one, at the start of a run."""
        if self.has_memory:
            try:
                self._driver.start()
            except Exception as error:
                raise DriverError(f"{self._target}.start failed ({_describe(error)})") from None

    def predict(self, frame: Frame) -> Prediction:
        """See `ds_driver.networks.pilot.Pilot`."""
        checked(frame.image)
        try:
            answer: Any = self._driver.drive(frame)
        except Exception as error:  # any exception in user code is an error, never a failed test
            raise DriverError(f"{self._target}.drive failed ({_describe(error)})") from None
        steering, throttle = answer if isinstance(answer, (tuple, list)) and len(answer) == 2 else (answer, None)
        try:
            numbers = float(steering), None if throttle is None else float(throttle)
        except (TypeError, ValueError):
            raise DriverError(
                f"{self._target}.drive returned {answer!r:.60}: expected the steering, or steering and throttle"
            ) from None
        return Prediction(*numbers)

    def seen(self, frame: Frame) -> tuple[NDArray[np.uint8], str]:
        """Return the whole image; see `Pilot.seen`."""
        return frame.image, "rgb"


def source_of(target: str) -> Path:
    """Return the source file of a class; a `DriverError` if it cannot be imported, or comes from no file."""
    file = getattr(sys.modules[_find(target).__module__], "__file__", None)
    if file is None:
        raise DriverError(f"driver {target} comes from no file: move it to a module")
    return Path(file)


def _find(target: str) -> type:
    module, _, attribute = target.partition(":")
    try:
        kind: type = getattr(import_module(module), attribute)
    except Exception as error:  # importing a module can raise anything
        raise DriverError(
            f"driver {target!r} cannot be imported ({_describe(error)}): expected module:Class, with the module in "
            "this folder or on PYTHONPATH"
        ) from None
    return kind


def _describe(error: Exception) -> str:
    return f"{type(error).__name__}: {last_line(error)}"


class NetworkDriver:
    """Maps images and speeds to commands; the same frames give the same bits in any process.

    Args:
        driver: a shipped network, a weights file, the YAML description of a network file, or `module:Class`; a backend
            may follow, as in `dave2@onnx`. `+` and a set of generators make it see translated images, as in
            `dave2+FOLDER`, and `+none` plain ones; a network that was trained on translated images names its own set.

    Raises:
        ValueError: the driver cannot be loaded; see `load_weights`, `DescribedNetworkPilot` and `UserClassPilot`.
    """

    def __init__(self, driver: DriverName | str) -> None:
        self._pilot = load_pilot(driver)
        # Warm up: the first image allocates memory and selects kernels.
        self.command(Frame.black())
        self._pilot.start()

    def command(self, frame: Frame) -> Command:
        """Compute the command for a frame; step 0 begins a run.

        Raises:
            ds_driver.networks.images.ImageError: the image has another size or type.
            ds_driver.networks.pilot.DriverError: the network gives no valid answer.
        """
        if frame.step == 0:
            self._pilot.start()
        return _command(self._pilot.predict(frame), frame.speed)

    def commands(self, frames: Sequence[Frame]) -> list[Command | DriverError]:
        """Compute a command for each frame: the bits of `command`, or the error of that frame.

        The frames, any number, are of one run, or of several if `largest_batch` is more than one; at most so many go
        through the network at once.

        Raises:
            ds_driver.networks.images.ImageError: an image has another size or type.
        """
        size = self.largest_batch
        if size == 1:
            return [attempt(self.command, frame) for frame in frames]
        parts = (frames[begin : begin + size] for begin in range(0, len(frames), size))
        predictions = [prediction for part in parts for prediction in self._pilot.predict_batch(part)]
        return [
            prediction if isinstance(prediction, DriverError) else _command(prediction, frame.speed)
            for frame, prediction in zip(frames, predictions, strict=True)
        ]

    @property
    def largest_batch(self) -> int:
        """Return the number of frames that the network takes at once with the bits that each gives alone."""
        return self._pilot.largest_batch

    def rows_seen(self, crop: Crop, height: int, simulator: str | None = None) -> tuple[int, int] | None:
        """Return first row and end of the rows that the driver looks at, None if it may look at all; see `Pilot`."""
        return self._pilot.rows_seen(crop, height, simulator or "")

    @property
    def translation(self) -> GeneratorSet | None:
        """Return what translates images before the network sees them; None if it sees them as they are."""
        return self._pilot.translation


def load_pilot(driver: DriverName | str) -> Pilot:
    """Load the driver of a name; see `NetworkDriver`.

    Examples:
        >>> from ds_driver import Frame, load_pilot
        >>> abs(load_pilot("dave2@onnx").predict(Frame.black()).steering) <= 1.0
        True
    """
    name = DriverName.of(driver)
    weights = load_weights(name.network) if name.has_weights else None
    translation = generators_of(name)
    pilot = _load_network(name) if weights is None else BuiltInPilot(weights, name.backend, name.device)
    return pilot if translation is None else TranslatingPilot(pilot, translation)


Translation = Callable[[NDArray[np.uint8]], NDArray[np.uint8]]
"""Maps a camera image to what a network sees of it, both (160, 320, 3) uint8 RGB."""


def translation_of(driver: DriverName, simulator: str) -> Translation | None:
    """Return how a driver sees a simulator's images, None if as they are; a DriverError without its generators."""
    translation = _kept_generators_of(driver)
    if translation is None:
        return None
    name, lock = spec_of(simulator).name, Lock()

    def translated(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        with lock:  # some backends compute one image at a time
            return translation.translate(image, name)

    return translated


def generators_of(driver: DriverName) -> GeneratorSet | None:
    """Find a driver's generators, None if it sees images as they are; a ValueError if there are no such files."""
    computed = default_backend() if driver.backend == "auto" else driver.backend, driver.device
    if driver.generators:
        return None if driver.generators == NO_GENERATORS else open_set(driver.generators, computed)
    trained_with = generators_in(driver.network) if driver.has_weights else {}
    return set_of_network(driver.network, trained_with, computed) if trained_with else None


_kept_generators_of = cache(generators_of)


def sees_translated(driver: DriverName) -> bool:
    """Return whether a driver sees translated images, also where its files are missing and only its name says so."""
    if driver.generators:
        return driver.generators != NO_GENERATORS
    try:
        return bool(driver.has_weights and generators_in(driver.network))
    except ValueError:
        return False


def _load_network(name: DriverName) -> Pilot:
    network = name.network
    if name.is_node:
        raise DriverError(
            f"{network} is a ROS node that you start: `ds drive` and `ds campaign run` drive it, with --attach"
        )
    if name.description is not None:
        return DescribedNetworkPilot(name.description, name.backend, name.device)
    if name.file_type in KINDS or not name.python_class:
        refuse_foreign(Path(network))
    if name.file_type in KINDS:
        raise DriverError(f"{network} has no description of its input: `{ds_command('check', network)}` writes one")
    if name.python_class:
        if name.suffix:
            raise DriverError(f"driver {network} is a class, which takes no backend and no device: leave them out")
        return UserClassPilot(name.python_class)
    names = [str(AUTOPILOT), *dict.fromkeys([*NETWORKS, *shipped_networks(), *installed("drivers")])]
    raise UnknownNetworkError(
        f"unknown driver {network!r}{did_you_mean(network, names)}: expected one of {', '.join(names)}, "
        "a .safetensors or .yaml file, or module:Class"
    )


def on_backend(driver: DriverName, backend: str = "") -> DriverName:
    """Name a driver with the back end that computes it, so that a record says what its bits depend on.

    One that names its back end, or has but one, stays as it is; `backend` is in place of `auto`, or "" for what that
    is here.
    """
    if driver.backend != "auto":
        return driver
    if (path := driver.description) is None:
        return driver.on(backend or default_backend()) if driver.has_weights else driver
    try:
        is_onnx = KINDS[file_of(path, read_description(path)).suffix.lower()] == "onnx"
    except DriverError:  # its files are gone: its record is read, and nothing driven
        is_onnx = False
    return driver.on(backend or DescribedNetworkPilot(path).backend) if is_onnx else driver


def driver_sha256(driver: DriverName) -> str:
    """Compute the SHA-256 of a driver's files: weights, description and network file, or a class's module; "" if none.

    Generators that it names are part of it; those of a network's training are so by their digests in it.
    """
    if not driver.has_files:
        return ""
    if driver.generators:
        generators, network = generators_of(driver), driver_sha256(DriverName(driver.network))
        parts_of_both = f"{network} {generators.sha256 if generators else driver.generators}"
        return hashlib.sha256(parts_of_both.encode()).hexdigest()
    if (path := driver.description) is not None:
        parts = [path, file_of(path, read_description(path))]
    elif driver.python_class:
        parts = [source_of(driver.python_class)]
    else:
        return weights_sha256(driver.network)
    return hashlib.sha256(b"".join(bytes.fromhex(sha256_of([part])) for part in parts)).hexdigest()


def _command(prediction: Prediction, speed: float) -> Command:
    steering = min(max(prediction.steering, -1.0), 1.0)
    if prediction.throttle is None:
        return Command(steering, throttle(steering, speed))
    return Command(steering, min(max(prediction.throttle, 0.0), 1.0))
