# SPDX-License-Identifier: Apache-2.0
"""The YAML file that describes a network file: its inputs, its outputs, and what they mean."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, ValidationError, model_validator

from ds_base.bounded_file import FileError
from ds_base.bounded_yaml import read_yaml
from ds_base.config_errors import Keys
from ds_driver.control.bicycle import Geometry, pursuit_curvature
from ds_driver.networks.images import Crop
from ds_driver.networks.network_file import KINDS, refuse_foreign
from ds_driver.networks.pilot import DriverError
from ds_sim.camera.spec import IMAGE_HEIGHT

GUIDE = "docs/bring_your_own_network.md"
MOST_FRAMES = 128
"""Longest memory, frames; chosen: six seconds at 20 Hz, and Donkey Car's longest is 20."""
MOST_NUMBERS = 2**20
"""Largest state; chosen: four times the cell state of 64 x 64 x 64."""
_LONGEST = 500
"""Longest error text about a description, characters."""


class Rows(Keys, allow_inf_nan=False):
    """Camera rows to crop."""

    top: Annotated[int, Field(ge=0, lt=IMAGE_HEIGHT)] = 0
    bottom: Annotated[int, Field(ge=0, lt=IMAGE_HEIGHT)] = 0


PerChannel = float | Annotated[list[float], Field(min_length=3, max_length=3)]
Shape = Annotated[list[Annotated[int, Field(ge=1, le=MOST_NUMBERS)]], Field(min_length=1, max_length=6)]


class InputSpec(Keys, allow_inf_nan=False):
    """Image that a network expects."""

    size: tuple[Annotated[int, Field(ge=1, le=4096)], Annotated[int, Field(ge=1, le=4096)]]  # rows and columns
    colour: Literal["rgb", "bgr", "yuv", "grey"] = "rgb"
    layout: Literal["nchw", "nhwc"] = "nchw"  # channels before the rows, or after the columns
    crop: Literal["simulator", "none"] | Rows = "none"  # `simulator`: as for the paper's networks
    resize: Literal["linear", "area", "nearest"] = "linear"
    type: Literal["float32", "uint8"] = "float32"
    subtract: PerChannel = 0.0  # from pixel values, 0 to 255
    divide: PerChannel = 1.0  # after that
    frames: Annotated[int, Field(ge=1, le=MOST_FRAMES)] = 1  # images seen at once; before the first, all are like it
    stride: Annotated[int, Field(ge=1, le=MOST_FRAMES)] = 1  # frames from one of them to the next
    order: Literal["oldest_first", "newest_first"] = "oldest_first"
    stacked: Literal["channels", "time"] = "channels"  # of one image, or over an axis of its own before the others

    @model_validator(mode="after")
    def _makes_sense(self) -> InputSpec:
        if not np.all(np.asarray(self.divide)):
            raise ValueError("divide is 0: expected the range of a pixel, such as 255")
        if self.type == "uint8" and (np.any(np.asarray(self.subtract)) or np.any(np.asarray(self.divide) != 1)):
            raise ValueError("type uint8 takes pixels as they are: leave out subtract and divide")
        if self.colour == "grey" and not (isinstance(self.subtract, float) and isinstance(self.divide, float)):
            raise ValueError("a grey image has one channel: give one number for subtract and divide")
        if isinstance(self.crop, Rows):
            Crop(self.crop.top, self.crop.bottom)
        return self

    @property
    def shape(self) -> tuple[int, ...]:
        """Return the shape of the input, with a batch of one."""
        channels = 1 if self.colour == "grey" else 3
        channels *= 1 if self.axis is None else self.frames
        one = (channels, *self.size) if self.layout == "nchw" else (*self.size, channels)
        return (1, self.frames, *one) if self.axis is None else (1, *one)

    @property
    def axis(self) -> int | None:
        """Return the axis of one image along which several are joined; None for an axis of their own."""
        return None if self.stacked == "time" else 0 if self.layout == "nchw" else 2


class OutputSpec(Keys, allow_inf_nan=False):
    """Location and scaling of one value among the outputs.

    Of an output of scores for `bins` it is the centre of the bin with the highest one (Donkey Car's `linear_unbin`).
    Steering after scale and offset, right positive, is a share of full steering, an angle of the wheels, or the
    curvature of the arc in 1/m.
    """

    output: Annotated[int, Field(ge=0)] | str = 0  # name or position
    index: Annotated[int, Field(ge=0)] = 0  # into the flattened output
    scale: float = 1.0
    offset: float = 0.0  # added after scaling
    bins: tuple[float, float] | None = None  # centres of the first and of the last
    expectation: bool = False  # the expected value of bins whose scores are probabilities
    unit: Literal["share", "degrees", "radians", "curvature"] = "share"
    ratio: Annotated[float, Field(gt=0.0)] = 1.0  # angle of a steering wheel, if that is given, per angle of the wheels

    @model_validator(mode="after")
    def _makes_sense(self) -> OutputSpec:
        if self.expectation and self.bins is None:
            raise ValueError("expectation is over bins: add bins, such as [-1, 1]")
        if self.ratio != 1.0 and self.unit not in ("degrees", "radians"):
            raise ValueError("ratio is of a steering wheel's angle: add unit, degrees or radians")
        return self

    def value(self, numbers: NDArray[np.float32]) -> float:
        """Return the value in a flattened output, which is long enough."""
        if self.bins is None:
            return float(numbers[self.index]) * self.scale + self.offset
        low, high = self.bins
        expected = float(np.sum(np.arange(numbers.size) * numbers.astype(np.float64)))
        place = expected if self.expectation else int(np.argmax(numbers))
        value = low + (high - low) * place / max(numbers.size - 1, 1)
        return value * self.scale + self.offset

    def steering(self, value: float, vehicle: Geometry | None) -> float:
        """Return the share of full steering, -1 left to +1 right; a DriverError if it needs an unknown vehicle."""
        if self.unit == "share":
            return value
        geometry = _known(vehicle, f"steering in {self.unit}")
        if self.unit == "curvature":
            return geometry.steering_of(geometry.angle_of_curvature(-value))
        return geometry.steering_of(-(math.radians(value) if self.unit == "degrees" else value) / self.ratio)


class PathSpec(Keys, allow_inf_nan=False):
    """Points on the ground that a network wants to pass, or one; pure pursuit steers towards them.

    Each point, the nearest first, is two numbers that follow each other, in the directions of `axes` from the origin.
    """

    output: Annotated[int, Field(ge=0)] | str = 0  # name or position
    index: Annotated[int, Field(ge=0)] = 0  # of the first number in the flattened output
    points: Annotated[int, Field(ge=1, le=1024)] = 1
    axes: tuple[Literal["forward", "left", "right"], Literal["forward", "left", "right"]] = ("forward", "left")
    scale: Annotated[float, Field(gt=0.0)] = 1.0  # m for each unit
    ahead: float = 0.0  # distance of the origin ahead of the middle of the rear axle, m
    lookahead: Annotated[float, Field(gt=0.0, le=1000.0)] | None = None  # where several points are pursued, m

    @model_validator(mode="after")
    def _makes_sense(self) -> PathSpec:
        if self.axes.count("forward") != 1:
            raise ValueError("axes are forward and either left or right")
        if (self.lookahead is None) != (self.points == 1):
            raise ValueError("lookahead is the distance in m at which several points are pursued: one point needs none")
        return self

    @property
    def numbers(self) -> int:
        """Return how many numbers the output has at least."""
        return self.index + 2 * self.points

    def steering(self, numbers: NDArray[np.float32], vehicle: Geometry | None) -> float:
        """Return the share of full steering that follows the path; a DriverError if the vehicle is unknown."""
        geometry = _known(vehicle, "a path")
        waypoints = numbers[self.index : self.numbers].astype(np.float64).reshape(-1, 2) * self.scale
        forward = self.axes.index("forward")
        left = waypoints[:, 1 - forward] * (-1.0 if "right" in self.axes else 1.0)
        path = np.column_stack([waypoints[:, forward] + self.ahead, left])
        return geometry.steering_of(geometry.angle_of_curvature(pursuit_curvature(path, self.lookahead or math.inf)))


def _known(vehicle: Geometry | None, what: str) -> Geometry:
    if vehicle is None:
        raise DriverError(
            f"{what} needs the vehicle, which is unknown for these images: give its wheelbase and max_steering_angle"
        )
    return vehicle


class Outputs(Keys, allow_inf_nan=False):
    """Outputs of a network: steering, or a path instead, and optionally throttle, 0 to 1."""

    steering: OutputSpec = OutputSpec()
    path: PathSpec | None = None
    throttle: OutputSpec | None = None

    @model_validator(mode="after")
    def _makes_sense(self) -> Outputs:
        if self.path is not None and "steering" in self.model_fields_set:
            raise ValueError("expected either steering or path")
        if self.throttle is not None and self.throttle.unit != "share":
            raise ValueError("throttle is a share from 0 to 1: leave unit out")
        return self


class GivenInput(Keys, allow_inf_nan=False):
    """One input of a network beside the image; exactly one of `state`, `value` and `constant` says what it is.

    A value is the speed of the vehicle in m/s; or what the network answered in the `last` frames, the oldest first: its
    steering, or its commands, pairs of steering and throttle (Donkey Car's `mem_in`). A constant may be a route's
    command, a behaviour, or an IMU at rest.
    """

    state: Annotated[int, Field(ge=0)] | str | None = None  # name or position of the output that comes back
    value: Literal["speed", "steering", "commands"] | None = None
    constant: float | Annotated[list[float], Field(min_length=1, max_length=1024)] | None = None
    last: Annotated[int, Field(ge=1, le=MOST_FRAMES)] = 1
    start: float = 0.0  # every number of it before the first frame
    scale: float = 1.0  # factor on a speed
    shape: Shape | None = None  # with a batch of one; needed for a state whose shape the file does not say

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
        """Return the described shape, else the file's with 1 for free sizes, else a row; a ValueError if none fits."""
        numbers = None
        if self.value is not None:
            numbers = self.last * (2 if self.value == "commands" else 1)
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
        if math.prod(shape) > MOST_NUMBERS:
            raise ValueError(f"a state of {'x'.join(map(str, shape))} is too large")
        if numbers is not None and math.prod(shape) != numbers:
            value_words = f"{self.value} of {self.last} frames" if self.value else "its constant"
            raise ValueError(f"it takes {math.prod(shape)} numbers, {value_words} gives {numbers}")
        return shape


class DescribedNetwork(Keys, allow_inf_nan=False):
    """Content of the YAML description; `file` is relative to its folder."""

    file: str
    input: InputSpec
    inputs: dict[Annotated[int, Field(ge=0)] | str, GivenInput] = {}
    outputs: Outputs = Outputs()

    @model_validator(mode="after")
    def _makes_sense(self) -> DescribedNetwork:
        if self.outputs.throttle is None and any(one.value == "commands" for one in self.inputs.values()):
            raise ValueError("commands are steering and throttle: add outputs.throttle, or take steering")
        return self

    @property
    def has_memory(self) -> bool:
        """Whether an answer depends on earlier frames."""
        return self.input.frames > 1 or any(one.remembers for one in self.inputs.values())


def read_description(path: Path) -> DescribedNetwork:
    """Read and check a description; a DriverError names the invalid keys and the allowed values."""
    try:
        raw = read_yaml(path)
    except OSError as error:
        raise DriverError(f"{path}: cannot be read ({error.strerror}): check the path") from None
    except FileError as error:
        raise DriverError(f"{path}: not YAML ({error})") from None
    try:
        return DescribedNetwork.model_validate(raw)
    except ValidationError as error:
        # pydantic reports a value of a union once for each member type.
        problems = {
            f"{'.'.join(str(part) for part in e['loc'] if not _is_kind(part)) or 'top level'}: "
            f"{e['msg'].removeprefix('Value error, ')}"
            for e in error.errors()
        }
        unknown = {".".join(map(str, e["loc"][:-1])) for e in error.errors() if e["type"] == "extra_forbidden"}
        models: dict[str, type[BaseModel]] = {"": DescribedNetwork, "input": InputSpec, "outputs": Outputs}
        models |= {"outputs.path": PathSpec}
        models |= {place: GivenInput for place in unknown if place.startswith("inputs.")}
        hint = "".join(
            f" (keys of {place or 'the file'}: {', '.join(models.get(place, OutputSpec).model_fields)})"
            for place in sorted(unknown)
        )
        text = " ".join(f"{'; '.join(sorted(problems))}{hint}".split())
        printable = "".join(c if c.isprintable() else "?" for c in text)
        shown = printable if len(printable) <= _LONGEST else f"{printable[:_LONGEST]}..."
        raise DriverError(f"{path}: {shown}: see {GUIDE}") from None


def file_of(path: Path, description: DescribedNetwork) -> Path:
    """Return the network file that a description, from `path`, names; a DriverError if it is missing or unknown."""
    file = path.parent / description.file
    is_path = "\0" not in description.file and len(description.file) <= 4096
    if not is_path or file.suffix.lower() not in KINDS:
        if is_path:
            refuse_foreign(file)
        raise DriverError(
            f"{path}: file {description.file!r:.100}: expected {', '.join(KINDS)}; {GUIDE} says how to convert"
        )
    if not file.is_file():
        raise DriverError(f"{path}: file {description.file!r} is missing: its path is relative to {path.name}")
    return file


def _is_kind(part: object) -> bool:
    """Check for the parts that pydantic adds to a path to name a member type of a union."""
    return isinstance(part, str) and (part in ("float", "int", "str", "Rows") or "[" in part)
