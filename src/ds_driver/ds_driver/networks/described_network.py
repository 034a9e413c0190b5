# SPDX-License-Identifier: Apache-2.0
"""Drives with a network file that a YAML file describes."""

from __future__ import annotations

import copy
import math
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_base.bounded_memory import limited_memory
from ds_driver.networks.backends import NetworkInput
from ds_driver.networks.description import (
    DescribedNetwork,
    GivenInput,
    InputSpec,
    OutputSpec,
    PathSpec,
    Rows,
    file_of,
    read_description,
)
from ds_driver.networks.images import Crop, checked
from ds_driver.networks.network_file import NETWORK_MEMORY, backends_for, runner_of
from ds_driver.networks.pilot import DriverError, Frame, Pilot, Prediction
from ds_sim.camera.spec import IMAGE_HEIGHT, IMAGE_WIDTH

ALIKE = 1e-3
"""Largest difference of two back ends' answers, absolute plus relative; chosen: single precision rounds by 1e-6."""
_COLOURS = {"bgr": cv2.COLOR_RGB2BGR, "yuv": cv2.COLOR_RGB2YUV, "grey": cv2.COLOR_RGB2GRAY}
_RESIZING = {"linear": cv2.INTER_LINEAR, "area": cv2.INTER_AREA, "nearest": cv2.INTER_NEAREST}
_Given = dict[int, tuple[GivenInput, tuple[int, ...]]]
"""Inputs beside the image, with their shapes, by position."""


class DescribedNetworkPilot(Pilot):
    """Drives with a network file as its description at `path` says, or `described` in its place; or a DriverError."""

    def __init__(
        self, path: Path, backend: str = "auto", device: str = "cpu", described: DescribedNetwork | None = None
    ) -> None:
        self.description = described or read_description(path)
        self.sees_crop_only = self.description.input.crop == "simulator"
        self.has_memory = self.description.has_memory
        self._known: dict[tuple[str, int], tuple[Frame, list[NDArray[np.float32]]]] = {}
        file = file_of(path, self.description)
        # The address space does not reflect the memory used on a GPU.
        self._bounded = nullcontext if device == "cuda" else partial(limited_memory, NETWORK_MEMORY)
        try:
            *faster, last = backends_for(file, backend)
            with self._bounded():
                if not any(self._answers_alike(file, one, last, device) for one in faster):
                    self._load(file, last, device)
        except MemoryError:
            raise DriverError(f"{file.name} needs more memory than a network may take: make it smaller") from None

    def _answers_alike(self, file: Path, backend: str, reference: str, device: str) -> bool:
        """Load a back end if it can run the file, and answers an image of noise as the reference does."""
        image = np.random.default_rng(0).integers(0, 256, (IMAGE_HEIGHT, IMAGE_WIDTH, 3), np.uint8)
        answers = []
        try:
            for one in (reference, backend):
                self._load(file, one, device)
                answers.append(self.outputs(replace(Frame.black(), image=image)))
                self.start()
            return all(np.allclose(a, b, ALIKE, ALIKE, equal_nan=True) for a, b in zip(*answers, strict=True))
        except ValueError:  # an error of the driver, or other shapes
            return False

    def _load(self, file: Path, backend: str, device: str) -> None:
        self.backend = backend
        self._runner = runner_of(file, backend, device)
        self._place, self._given = _places(file.name, self._runner.inputs, self.description)
        self.start()
        self._check(file.name)
        self.start()

    def described_as(self, description: DescribedNetwork) -> DescribedNetworkPilot:
        """Return a pilot of the same loaded network and answers, with another description of the same input shape."""
        other = copy.copy(self)
        other.description = description
        return other

    def start(self) -> None:
        """Forget the images, commands and states of the run before."""
        self._memory = _RunMemory(self.description.input, self._given)

    def predict(self, frame: Frame) -> Prediction:
        """See `ds_driver.networks.pilot.Pilot`."""
        outputs, spec = self.outputs(frame), self.description.outputs
        if spec.path is None:
            steering = spec.steering.steering(self._number(outputs, "steering", spec.steering), frame.vehicle)
        else:
            steering = spec.path.steering(self._numbers(outputs, "path", spec.path, spec.path.numbers), frame.vehicle)
        throttle = None if spec.throttle is None else self._number(outputs, "throttle", spec.throttle)
        prediction = Prediction(steering, throttle)
        states = {k: self._state(outputs, k) for k, (one, _) in self._given.items() if one.state is not None}
        self._memory.note(states, prediction)
        return prediction

    @property
    def input_names(self) -> tuple[str, ...]:
        """Return the names of the inputs; () if the file has none."""
        return tuple(one.name for one in self._runner.inputs)

    @property
    def output_names(self) -> tuple[str, ...]:
        """Return the names of the outputs; () if the file has none."""
        return self._runner.outputs

    def outputs(self, frame: Frame) -> list[NDArray[np.float32]]:
        """Compute all outputs of the network for the next frame of a run."""
        inputs = self._memory.inputs(self.pixels(frame), self._place, frame.speed)
        with self._bounded():
            return self._runner.compute(*inputs)

    def outputs_once(self, frame: Frame) -> list[NDArray[np.float32]]:
        """Compute all outputs of a network without memory, or return those of the same `Frame` object again."""
        key = self.description.input.model_dump_json(), id(frame)
        if key not in self._known:
            self._known[key] = frame, self.outputs(frame)
        return self._known[key][1]

    def seen(self, frame: Frame) -> tuple[NDArray[np.uint8], str]:
        """Return what the network sees of a frame, before pixels are scaled; see `Pilot.seen`."""
        spec = self.description.input
        image = checked(frame.image)
        crop = frame.crop if spec.crop == "simulator" else Crop()
        if isinstance(spec.crop, Rows):
            crop = Crop(spec.crop.top, spec.crop.bottom)
        image = image[crop.top : IMAGE_HEIGHT - crop.bottom]
        if image.shape[:2] != spec.size:
            image = np.asarray(cv2.resize(image, spec.size[::-1], interpolation=_RESIZING[spec.resize]), np.uint8)
        if spec.colour != "rgb":
            image = np.asarray(cv2.cvtColor(image, _COLOURS[spec.colour]), np.uint8)
        return image.reshape(*spec.size, -1), spec.colour

    def pixels(self, frame: Frame) -> NDArray[Any]:
        """Convert the image of a frame to that of the network, scaled, in its layout."""
        spec = self.description.input
        pixels: NDArray[Any] = self.seen(frame)[0]
        if spec.type == "float32":
            subtract, divide = (np.asarray(number, np.float32) for number in (spec.subtract, spec.divide))
            pixels = (pixels.astype(np.float32) - subtract) / divide
        if spec.layout == "nchw":
            pixels = pixels.transpose(2, 0, 1)
        return pixels

    def _check(self, name: str) -> None:
        """Compare the file with the description, and warm up with a black image."""
        spec = self.description.input
        image = self._runner.inputs[self._place] if self._runner.inputs else NetworkInput()
        if image.shape is not None and not _fits(image.shape, spec.shape):
            raise DriverError(
                f"{name} expects an input of {sizes(image.shape)}, its description gives {sizes(spec.shape)}: "
                "correct size or layout"
            )
        if image.type and image.type != spec.type:
            raise DriverError(
                f"{name} expects input of type {image.type}, its description gives {spec.type}: correct type"
            )
        try:
            self.predict(Frame.black())
        except DriverError as error:
            raise DriverError(f"{name} fails on a black image: {error}") from None

    def _output(self, outputs: list[NDArray[np.float32]], what: str, wanted: int | str) -> NDArray[np.float32]:
        names = self._runner.outputs
        if isinstance(wanted, str):
            if wanted not in names:
                choices = ", ".join(name for name in names if name) or "none has a name, give its position"
                raise DriverError(f"there is no output {wanted!r} for {what}: expected one of {choices}")
            return outputs[names.index(wanted)]
        if wanted >= len(outputs):
            raise DriverError(f"no output {wanted} for {what}: the network has {len(outputs)}, counted from 0")
        return outputs[wanted]

    def _state(self, outputs: list[NDArray[np.float32]], place: int) -> NDArray[np.float32]:
        spec, shape = self._given[place]
        assert spec.state is not None
        state = self._output(outputs, f"the state of input {place}", spec.state)
        if state.size != math.prod(shape):
            raise DriverError(
                f"output {spec.state!r} has {state.size} numbers, the input that it comes back in has "
                f"{math.prod(shape)}: name another output"
            )
        return state

    def _number(self, outputs: list[NDArray[np.float32]], what: str, spec: OutputSpec) -> float:
        return spec.value(self._numbers(outputs, what, spec, 2 if spec.bins else spec.index + 1))

    def _numbers(
        self, outputs: list[NDArray[np.float32]], what: str, spec: OutputSpec | PathSpec, wanted: int
    ) -> NDArray[np.float32]:
        output = self._output(outputs, what, spec.output)
        if output.size < wanted:
            raise DriverError(f"the output for {what} has {output.size} numbers: its description needs {wanted}")
        return output.reshape(-1)


def _places(name: str, inputs: Sequence[NetworkInput], described: DescribedNetwork) -> tuple[int, _Given]:
    """Find the position of the image, and the other inputs; refuse a file with others than its description."""
    names_in_file = [one.name for one in inputs]
    count = len(inputs) or 1 + len(described.inputs)

    def place_of(key: int | str) -> int:
        if isinstance(key, str) and key in names_in_file:
            return names_in_file.index(key)
        if isinstance(key, int) and key < count:
            return key
        expected = ", ".join(filter(None, names_in_file)) or f"its position, 0 to {count - 1}"
        raise DriverError(f"{name} has no input {key!r}: expected {expected}")

    input_at = {place_of(key): one for key, one in described.inputs.items()}
    free = [place for place in range(count) if place not in input_at]
    if len(free) != 1:
        named = ", ".join(one or f"number {place}" for place, one in enumerate(names_in_file))
        raise DriverError(
            f"{name} has {count} inputs ({named}), its description gives {1 + len(described.inputs)}: `input` is the "
            "image, and each other one stands in `inputs`, as `h: {state: OUTPUT}` or `speed: {value: speed}`"
        )
    given = {}
    for place, one in input_at.items():
        expected = inputs[place].shape if inputs else None
        try:
            shape = one.shape_in(expected)
        except ValueError as error:
            raise DriverError(f"{name}, input {names_in_file[place] if names_in_file else place}: {error}") from None
        if expected is not None and not _fits(expected, shape):
            raise DriverError(
                f"{name} expects {sizes(expected)} as input {names_in_file[place] or place}, its description gives "
                f"{sizes(shape)}: correct shape"
            )
        given[place] = one, shape
    return free[0], given


class _RunMemory:
    """Images, commands and states of one run so far."""

    def __init__(self, spec: InputSpec, given: _Given) -> None:
        self._spec, self._given = spec, given
        self._images: deque[NDArray[Any]] = deque(maxlen=(spec.frames - 1) * spec.stride + 1)
        self._values: dict[int, NDArray[np.float32]] = {
            place: np.resize(np.array(one.start if one.constant is None else one.constant, np.float32), shape)
            for place, (one, shape) in given.items()
        }

    def inputs(self, pixels: NDArray[Any], place: int, speed: float) -> list[NDArray[Any]]:
        """Remember the pixels of a frame, and return all inputs in order; the image is at `place`."""
        spec = self._spec
        self._images.append(pixels)
        back = [min(k * spec.stride, len(self._images) - 1) for k in range(spec.frames)]
        stack = [self._images[-1 - k] for k in (back if spec.order == "newest_first" else reversed(back))]
        stacked = np.stack(stack) if spec.axis is None else np.concatenate(stack, spec.axis)
        for position, (one, shape) in self._given.items():
            if one.value == "speed":
                self._values[position] = np.full(shape, speed * one.scale, np.float32)
        inputs: dict[int, NDArray[Any]] = {**self._values, place: np.ascontiguousarray(stacked[None])}
        return [inputs[position] for position in sorted(inputs)]

    def note(self, states: Mapping[int, NDArray[np.float32]], answer: Prediction) -> None:
        """Remember what the network answered; `states` are the outputs that come back, by position of the input."""
        for position, (one, shape) in self._given.items():
            if one.state is not None:
                self._values[position] = np.array(states[position], np.float32).reshape(shape)
            elif one.remembers:
                newest = [answer.steering] if one.value == "steering" else [answer.steering, answer.throttle or 0.0]
                before = self._values[position].reshape(-1)[len(newest) :]
                self._values[position] = np.array([*before, *newest], np.float32).reshape(shape)


def _fits(expected: Sequence[int | None], shape: Sequence[int]) -> bool:
    return len(expected) == len(shape) and all(a in (None, b) for a, b in zip(expected, shape, strict=True))


def sizes(shape: Sequence[int | None]) -> str:
    """Write a shape, for messages."""
    return "x".join("any" if size is None else str(size) for size in shape)
