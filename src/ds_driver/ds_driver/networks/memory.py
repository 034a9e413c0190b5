# SPDX-License-Identifier: Apache-2.0
"""Input of described networks beside one image: earlier images, commands and states of the run."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

MOST_FRAMES = 128
"""Longest memory, frames; chosen: six seconds at 20 Hz, and Donkey Car's longest is 20."""
MOST_NUMBERS = 2**20
"""Largest state; chosen: four times the cell state of 64 x 64 x 64."""


class GivenInput(BaseModel):
    """One input of a network beside the image; exactly one of `state`, `value` and `constant` says what it is.

    Attributes:
        state: name or position of the output that comes back in the next frame.
        value: `speed` of the vehicle in m/s; or what the network itself answered in the `last` frames, the oldest
            first: its `steering`, or its `commands`, which are pairs of steering and throttle (Donkey Car's `mem_in`).
        constant: the same numbers in every frame, or one for all: a route's command, a behaviour, an IMU at rest.
        last: number of frames; only with `steering` and `commands`.
        start: every number of it before the first frame.
        scale: factor on a speed.
        shape: with a batch of one; needed for a state whose shape the file does not say.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    state: Annotated[int, Field(ge=0)] | str | None = None
    value: Literal["speed", "steering", "commands"] | None = None
    constant: float | Annotated[list[float], Field(min_length=1, max_length=1024)] | None = None
    last: Annotated[int, Field(ge=1, le=MOST_FRAMES)] = 1
    start: float = 0.0
    scale: float = 1.0
    shape: Annotated[list[Annotated[int, Field(ge=1, le=MOST_NUMBERS)]], Field(min_length=1, max_length=6)] | None = (
        None
    )

    @model_validator(mode="after")
    def _makes_sense(self) -> GivenInput:
        if [self.state, self.value, self.constant].count(None) != 2:
            raise ValueError(
                "expected one of state, an output that comes back, value: speed, steering or commands, and constant"
            )
        if self.last != 1 and self.value not in ("steering", "commands"):
            raise ValueError("last counts frames of steering or commands: leave it out")
        if self.scale != 1.0 and self.value != "speed":
            raise ValueError("scale is for a speed: leave it out")
        return self

    @property
    def remembers(self) -> bool:
        """Whether it holds what was before."""
        return self.value != "speed" and self.constant is None

    def shape_in(self, file: Sequence[int | None] | None) -> tuple[int, ...]:
        """Return its shape: the described one, else the file's, whose free sizes are 1, else one row of numbers.

        Raises:
            ValueError: it cannot be known, is too large, or does not hold the values.
        """
        numbers = None
        if self.value is not None:
            numbers = 1 if self.value == "speed" else self.last * (2 if self.value == "commands" else 1)
        elif isinstance(self.constant, list):
            numbers = len(self.constant)
        if self.shape is not None:
            shape = tuple(self.shape)
        elif file is not None:
            shape = tuple(size or 1 for size in file)
        elif numbers is not None:
            shape = (1, numbers)
        else:
            raise ValueError("the file does not say the shape of this input: add shape, with a batch of 1")
        if np.prod(shape) > MOST_NUMBERS:
            raise ValueError(f"a state of {'x'.join(map(str, shape))} is too large")
        if numbers is not None and np.prod(shape) != numbers:
            value_words = f"{self.value} of {self.last} frames" if self.value else "its constant"
            raise ValueError(f"it takes {int(np.prod(shape))} numbers, {value_words} gives {numbers}")
        return shape


class RunMemory:
    """Images, commands and states of one run so far.

    Args:
        given: inputs beside the image, by position, with their shapes.
        frames: images that the network sees at once.
        stride: frames from one of them to the next.
        newest_first: their order.
        axis: of the pixels, along which images are joined; None for an axis of their own, before the others.
    """

    def __init__(
        self,
        inputs: Mapping[int, tuple[GivenInput, tuple[int, ...]]],
        *,
        frames: int = 1,
        stride: int = 1,
        newest_first: bool = False,
        axis: int | None = None,
    ) -> None:
        self._given = inputs
        self._frames, self._stride, self._newest_first, self._axis = frames, stride, newest_first, axis
        self.start()

    def start(self) -> None:
        """Forget everything: a run begins."""
        self._images: deque[NDArray[Any]] = deque(maxlen=(self._frames - 1) * self._stride + 1)
        self._values: dict[int, NDArray[np.float32]] = {
            place: np.resize(np.array(one.start if one.constant is None else one.constant, np.float32), shape)
            for place, (one, shape) in self._given.items()
        }

    def inputs(self, pixels: NDArray[Any], place: int, speed: float) -> list[NDArray[Any]]:
        """Remember the pixels of a frame, and return all inputs of the network in order, each with a batch of one.

        Before the first frame all images are like the first one.

        Args:
            pixels: one image, scaled, in the network's layout.
            place: position of the image among the inputs.
            speed: m/s.
        """
        self._images.append(pixels)
        back = [min(k * self._stride, len(self._images) - 1) for k in range(self._frames)]
        stack = [self._images[-1 - k] for k in (back if self._newest_first else reversed(back))]
        stacked = np.stack(stack) if self._axis is None else np.concatenate(stack, self._axis)
        for position, (one, shape) in self._given.items():
            if one.value == "speed":
                self._values[position] = np.full(shape, speed * one.scale, np.float32)
        inputs: dict[int, NDArray[Any]] = {**self._values, place: np.ascontiguousarray(stacked[None])}
        return [inputs[position] for position in sorted(inputs)]

    def note(self, states: Mapping[int, NDArray[np.float32]], steering: float, throttle: float | None) -> None:
        """Remember what the network answered.

        Args:
            states: position of an input -> the output that comes back in it, of as many numbers.
            steering: its answer.
            throttle: its answer, if it has one.
        """
        for position, (one, shape) in self._given.items():
            if one.state is not None:
                self._values[position] = np.array(states[position], np.float32).reshape(shape)
            elif one.remembers:
                answer = [steering] if one.value == "steering" else [steering, throttle or 0.0]
                before = self._values[position].reshape(-1)[len(answer) :]
                self._values[position] = np.array([*before, *answer], np.float32).reshape(shape)
