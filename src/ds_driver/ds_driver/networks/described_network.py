"""Drives by an ONNX, TorchScript or TensorFlow Lite file that a YAML file describes."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from ds_driver.networks.backends import (
    BackendError,
    Runner,
    onnx_runner,
    openvino_runner,
    torch_device,
    torchscript_runner,
)
from ds_driver.networks.memory_limit import limited_memory
from ds_driver.networks.pilot import DriverError, Frame, Prediction
from ds_driver.networks.preprocessing import Crop, checked
from ds_sim.bounded_yaml import BoundedYamlError, read_bounded, read_yaml
from ds_sim.camera.spec import IMAGE_HEIGHT, IMAGE_WIDTH

KINDS = {
    ".onnx": "onnx",
    ".pt": "torchscript",
    ".ts": "torchscript",
    ".torchscript": "torchscript",
    ".tflite": "tflite",
}
"""A file's ending -> what it holds."""
_COMPUTED_BY = {"onnx": ("onnx", "openvino"), "torchscript": ("torch", "openvino"), "tflite": ("openvino",)}
"""What a file holds -> backends that can compute it, `auto` first."""
_COLOURS = {"bgr": cv2.COLOR_RGB2BGR, "yuv": cv2.COLOR_RGB2YUV, "grey": cv2.COLOR_RGB2GRAY}
_RESIZING = {"linear": cv2.INTER_LINEAR, "area": cv2.INTER_AREA, "nearest": cv2.INTER_NEAREST}
GUIDE = "docs/bring_your_own_network.md"
LARGEST_FILE = 2**29
"""Bytes of a network file; chosen: five times the largest shipped network."""
_LONGEST = 500
"""Characters about what is wrong with a description."""


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Rows(_Strict):
    """Camera rows that are cut off."""

    top: Annotated[int, Field(ge=0, lt=IMAGE_HEIGHT)] = 0
    bottom: Annotated[int, Field(ge=0, lt=IMAGE_HEIGHT)] = 0


PerChannel = float | Annotated[list[float], Field(min_length=3, max_length=3)]


class InputSpec(_Strict):
    """What a network wants to see.

    Attributes:
        size: rows and columns.
        colour: order of the channels.
        layout: channels before the rows, or behind the columns.
        crop: `simulator` cuts what the paper's networks do not see there, `none` nothing, or rows of 160.
        resize: how the image is brought to its size.
        type: of the numbers.
        subtract: from a pixel of 0 to 255, one number or one per channel.
        divide: by this, after that.
    """

    size: tuple[Annotated[int, Field(ge=1, le=4096)], Annotated[int, Field(ge=1, le=4096)]]
    colour: Literal["rgb", "bgr", "yuv", "grey"] = "rgb"
    layout: Literal["nchw", "nhwc"] = "nchw"
    crop: Literal["simulator", "none"] | Rows = "none"
    resize: Literal["linear", "area", "nearest"] = "linear"
    type: Literal["float32", "uint8"] = "float32"
    subtract: PerChannel = 0.0
    divide: PerChannel = 1.0

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
    def shape(self) -> tuple[int, int, int, int]:
        """Of the input, with a batch of one."""
        channels = 1 if self.colour == "grey" else 3
        return (1, channels, *self.size) if self.layout == "nchw" else (1, *self.size, channels)


class OutputSpec(_Strict):
    """Where one number of the answer is.

    Attributes:
        output: name, or position among the outputs.
        index: in that output, counted through all its dimensions.
        scale: the number is multiplied by it; below 0 it changes the sign.
        offset: is added after that.
    """

    output: Annotated[int, Field(ge=0)] | str = 0
    index: Annotated[int, Field(ge=0)] = 0
    scale: float = 1.0
    offset: float = 0.0


class Outputs(_Strict):
    """What a network answers: steering, -1 left to +1 right, and perhaps a throttle, 0 to 1."""

    steering: OutputSpec = OutputSpec()
    throttle: OutputSpec | None = None


class DescribedNetwork(_Strict):
    """A description, as the YAML file has it; `file` is relative to it."""

    file: str
    input: InputSpec
    outputs: Outputs = Outputs()


def read_description(path: Path) -> DescribedNetwork:
    """Read and check a description.

    Raises:
        DriverError: in one line, the key, what is wrong with it, and what is allowed.
    """
    try:
        raw = read_yaml(path, unique_keys=True)
    except OSError as error:
        raise DriverError(f"{path}: cannot be read ({error.strerror}): check the path") from None
    except BoundedYamlError as error:
        raise DriverError(f"{path}: not YAML ({error})") from None
    try:
        return DescribedNetwork.model_validate(raw)
    except ValidationError as error:
        # A value that may be one of several kinds is told once for each kind.
        problems = {
            f"{'.'.join(str(part) for part in e['loc'] if not _is_kind(part)) or 'top level'}: "
            f"{e['msg'].removeprefix('Value error, ')}"
            for e in error.errors()
        }
        unknown = {".".join(map(str, e["loc"][:-1])) for e in error.errors() if e["type"] == "extra_forbidden"}
        models: dict[str, type[BaseModel]] = {"": DescribedNetwork, "input": InputSpec, "outputs": Outputs}
        hint = "".join(
            f" (keys of {place or 'the file'}: {', '.join(models.get(place, OutputSpec).model_fields)})"
            for place in sorted(unknown)
        )
        text = " ".join(f"{'; '.join(sorted(problems))}{hint}".split())
        printable = "".join(c if c.isprintable() else "?" for c in text)
        shown = printable if len(printable) <= _LONGEST else f"{printable[:_LONGEST]}..."
        raise DriverError(f"{path}: {shown}: see {GUIDE}") from None


def file_of(path: Path, description: DescribedNetwork) -> Path:
    """The network's own file.

    Raises:
        DriverError: it is missing, or of a kind that is not known.
    """
    file = path.parent / description.file
    if file.suffix.lower() not in KINDS or "\0" in description.file or len(description.file) > 4096:
        raise DriverError(
            f"{path}: file {description.file!r:.100}: expected {', '.join(KINDS)}; {GUIDE} says how to convert"
        )
    if not file.is_file():
        raise DriverError(f"{path}: file {description.file!r} is missing: its path is relative to {path.name}")
    return file


class DescribedNetworkPilot:
    """Drives by a described file.

    Args:
        path: of the description.
        backend: `auto` or another one that can compute the file.
        device: `cpu`, or `cuda` for TorchScript.

    Raises:
        DriverError: the description or the file cannot be used.
        BackendError: the backend cannot compute it.
    """

    def __init__(self, path: Path, backend: str = "auto", device: str = "cpu") -> None:
        self._spec = read_description(path)
        file = file_of(path, self._spec)
        # On a GPU the address space says nothing of the memory taken.
        self._bounded = nullcontext if device == "cuda" else limited_memory
        try:
            with self._bounded():
                self._runner = _runner(file, backend, device)
                self._check(file.name)
        except MemoryError:
            raise DriverError(f"{file.name} needs more memory than a network may take: make it smaller") from None

    def start(self) -> None:
        """A file keeps nothing of a run."""

    def predict(self, seen: Frame) -> Prediction:
        """See `ds_driver.networks.pilot.Pilot`."""
        batch = self.batch(seen)
        with self._bounded():
            outputs = self._runner.compute(batch)
        throttle = self._spec.outputs.throttle
        return Prediction(
            self._number(outputs, "steering", self._spec.outputs.steering),
            None if throttle is None else self._number(outputs, "throttle", throttle),
        )

    def batch(self, seen: Frame) -> NDArray[Any]:
        """The network's input for a frame, with a batch of one."""
        spec = self._spec.input
        image = checked(seen.image)
        crop = seen.crop if spec.crop == "simulator" else Crop()
        if isinstance(spec.crop, Rows):
            crop = Crop(spec.crop.top, spec.crop.bottom)
        image = image[crop.top : IMAGE_HEIGHT - crop.bottom]
        if image.shape[:2] != spec.size:
            image = cv2.resize(image, spec.size[::-1], interpolation=_RESIZING[spec.resize])
        if spec.colour != "rgb":
            image = cv2.cvtColor(image, _COLOURS[spec.colour])
        pixels: NDArray[Any] = image.reshape(*spec.size, -1)
        if spec.type == "float32":
            subtract, divide = (np.asarray(number, np.float32) for number in (spec.subtract, spec.divide))
            pixels = (pixels.astype(np.float32) - subtract) / divide
        if spec.layout == "nchw":
            pixels = pixels.transpose(2, 0, 1)
        return np.ascontiguousarray(pixels[None])

    def _check(self, name: str) -> None:
        """Hold the file against the description, and compute a black image: the first one takes longest."""
        runner, spec = self._runner, self._spec.input
        if runner.shape is not None and (
            len(runner.shape) != 4 or any(a not in (None, b) for a, b in zip(runner.shape, spec.shape, strict=True))
        ):
            wanted = "x".join("any" if size is None else str(size) for size in runner.shape)
            given = "x".join(map(str, spec.shape))
            raise DriverError(f"{name} wants an input of {wanted}, its description gives {given}: mend size or layout")
        if runner.type and runner.type != spec.type:
            raise DriverError(
                f"{name} wants numbers of type {runner.type}, its description gives {spec.type}: mend type"
            )
        black = np.zeros((IMAGE_HEIGHT, IMAGE_WIDTH, 3), np.uint8)
        try:
            self.predict(Frame(image=black, speed=0.0))
        except DriverError as error:
            raise DriverError(f"{name}, tried on a black image: {error}") from None

    def _number(self, outputs: list[NDArray[np.float32]], what: str, spec: OutputSpec) -> float:
        names = self._runner.outputs
        if isinstance(spec.output, str):
            if spec.output not in names:
                known = ", ".join(name for name in names if name) or "none has a name, give its position"
                raise DriverError(f"there is no output {spec.output!r} for {what}: expected one of {known}")
            found = outputs[names.index(spec.output)]
        elif spec.output < len(outputs):
            found = outputs[spec.output]
        else:
            raise DriverError(f"there is no output {spec.output} for {what}: it has {len(outputs)}, counted from 0")
        if spec.index >= found.size:
            raise DriverError(f"there is no index {spec.index} for {what}: the output has {found.size} numbers")
        return float(found.reshape(-1)[spec.index]) * spec.scale + spec.offset


def _runner(file: Path, backend: str, device: str) -> Runner:
    kind = KINDS[file.suffix.lower()]
    able = _COMPUTED_BY[kind]
    chosen = able[0] if backend == "auto" else backend
    if chosen not in able:
        raise BackendError(f"{file.name} cannot be computed by {chosen}: expected {' or '.join(able)}")
    try:
        content = read_bounded(file, LARGEST_FILE)
    except (BoundedYamlError, OSError) as error:
        raise DriverError(f"{file} cannot be read ({getattr(error, 'strerror', None) or error})") from None
    if chosen == "openvino":
        return openvino_runner(content, file.name, kind=kind)
    if chosen == "onnx":
        return onnx_runner(content, file.name)
    return torchscript_runner(content, torch_device(device), file.name)


def _is_kind(part: object) -> bool:
    """True for what pydantic puts into a path to tell the kinds of a value apart."""
    return isinstance(part, str) and (part in ("float", "int", "str", "Rows") or "[" in part)
