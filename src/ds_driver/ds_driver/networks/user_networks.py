"""Drives with user-provided networks: network files that a YAML file describes, and Python classes."""

from __future__ import annotations

import copy
import resource
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from ds_driver.networks.backends import (
    BackendError,
    NetworkInput,
    Runner,
    check_onnx,
    last_line,
    onnx_runner,
    openvino_runner,
)
from ds_driver.networks.calibration import calibration_frames
from ds_driver.networks.images import Crop, checked
from ds_driver.networks.memory import MOST_FRAMES, GivenInput, RunMemory
from ds_driver.networks.pilot import DriverError, Frame, Pilot, Prediction
from ds_driver.networks.quantisation import Samples, for_backend
from ds_sim.bounded_yaml import BoundedYamlError, read_bounded, read_yaml
from ds_sim.camera.spec import IMAGE_HEIGHT, IMAGE_WIDTH
from ds_sim.installation import ds_command

NETWORK_MEMORY = 4 * 2**30
"""Bytes beyond what the process has already mapped; chosen: 40 times the largest shipped network."""
WEIGHTS_ALONE = (".pth", ".ckpt")
"""File suffixes of PyTorch's weights without their network; nothing here unpickles them."""
_lock = threading.Lock()
_inside = 0
_before = (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
KINDS = {
    ".onnx": "onnx",
    ".pt": "torchscript",
    ".ts": "torchscript",
    ".torchscript": "torchscript",
    ".tflite": "tflite",
}
"""File suffix -> format."""
_BACKENDS_OF = {
    "onnx": ("onnx", "openvino", "openvino-bf16", "openvino-int8"),
    "torchscript": ("torch", "openvino", "openvino-bf16"),
    "tflite": ("openvino", "openvino-bf16"),
}
"""Format -> backends that can run it; the first one is `auto`."""
_COLOURS = {"bgr": cv2.COLOR_RGB2BGR, "yuv": cv2.COLOR_RGB2YUV, "grey": cv2.COLOR_RGB2GRAY}
_RESIZING = {"linear": cv2.INTER_LINEAR, "area": cv2.INTER_AREA, "nearest": cv2.INTER_NEAREST}
GUIDE = "docs/bring_your_own_network.md"
LARGEST_FILE = 2**29
"""Bytes of a network file; chosen: five times the largest shipped network."""
_LONGEST = 500
"""Longest error text about a description, characters."""


@contextmanager
def limited_memory(extra: int = NETWORK_MEMORY) -> Iterator[None]:
    """Make allocations fail beyond the present address space plus `extra` bytes.

    A graph of three nodes can ask for terabytes, and the runtimes set no limit. The limit applies to the whole process,
    other threads included; nested and concurrent uses keep the first limit.
    """
    global _inside, _before
    with _lock:
        _inside += 1
        if _inside == 1:
            _before = resource.getrlimit(resource.RLIMIT_AS)
            pages = int(Path("/proc/self/statm").read_text().split()[0])
            wanted = pages * resource.getpagesize() + extra
            limits = [limit for limit in (*_before, wanted) if limit != resource.RLIM_INFINITY]
            resource.setrlimit(resource.RLIMIT_AS, (min(limits), _before[1]))
    try:
        yield
    finally:
        with _lock:
            _inside -= 1
            if _inside == 0:
                resource.setrlimit(resource.RLIMIT_AS, _before)


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Rows(_Strict):
    """Camera rows to crop."""

    top: Annotated[int, Field(ge=0, lt=IMAGE_HEIGHT)] = 0
    bottom: Annotated[int, Field(ge=0, lt=IMAGE_HEIGHT)] = 0


PerChannel = float | Annotated[list[float], Field(min_length=3, max_length=3)]


class InputSpec(_Strict):
    """Image that a network expects.

    Attributes:
        size: rows and columns.
        colour: colour space and channel order.
        layout: channels before the rows, or after the columns.
        crop: `simulator` crops as for the paper's networks, `none` not at all, or rows out of 160.
        resize: interpolation used to resize the image.
        type: data type.
        subtract: subtracted from pixel values (0 to 255), one number or one per channel.
        divide: divisor applied after that, one number or one per channel.
        frames: number of images that it sees at once; before the first one, all are like it.
        stride: frames from one of them to the next.
        order: of these images.
        stacked: as `channels` of one image, or over `time`, an axis of its own before the others.
    """

    size: tuple[Annotated[int, Field(ge=1, le=4096)], Annotated[int, Field(ge=1, le=4096)]]
    colour: Literal["rgb", "bgr", "yuv", "grey"] = "rgb"
    layout: Literal["nchw", "nhwc"] = "nchw"
    crop: Literal["simulator", "none"] | Rows = "none"
    resize: Literal["linear", "area", "nearest"] = "linear"
    type: Literal["float32", "uint8"] = "float32"
    subtract: PerChannel = 0.0
    divide: PerChannel = 1.0
    frames: Annotated[int, Field(ge=1, le=MOST_FRAMES)] = 1
    stride: Annotated[int, Field(ge=1, le=MOST_FRAMES)] = 1
    order: Literal["oldest_first", "newest_first"] = "oldest_first"
    stacked: Literal["channels", "time"] = "channels"

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


class OutputSpec(_Strict):
    """Location and scaling of one value among the outputs.

    Attributes:
        output: name or position of the output.
        index: index into the flattened output.
        scale: factor applied to the value; negative to flip the sign.
        offset: added after scaling.
        bins: the output holds scores of bins, and the value is the centre of the bin with the highest score (Donkey
            Car's `linear_unbin`); centres of the first and the last bin, or true for -1 and +1. `index` is not used.
        expectation: of bins whose scores are probabilities, take the expected value instead.
    """

    output: Annotated[int, Field(ge=0)] | str = 0
    index: Annotated[int, Field(ge=0)] = 0
    scale: float = 1.0
    offset: float = 0.0
    bins: bool | tuple[float, float] = False
    expectation: bool = False

    @model_validator(mode="after")
    def _makes_sense(self) -> OutputSpec:
        if self.expectation and not self.bins:
            raise ValueError("expectation is over bins: add bins, such as [-1, 1]")
        return self

    def value(self, numbers: NDArray[np.float32]) -> float:
        """Return the value in a flattened output, which is long enough."""
        if self.bins:
            low, high = self.bins if isinstance(self.bins, tuple) else (-1.0, 1.0)
            expected = float(np.sum(np.arange(numbers.size) * numbers.astype(np.float64)))
            place = expected if self.expectation else int(np.argmax(numbers))
            found = low + (high - low) * place / max(numbers.size - 1, 1)
        else:
            found = float(numbers[self.index])
        return found * self.scale + self.offset


class Outputs(_Strict):
    """Outputs of a network: steering, -1 left to +1 right, and optionally throttle, 0 to 1."""

    steering: OutputSpec = OutputSpec()
    throttle: OutputSpec | None = None


class DescribedNetwork(_Strict):
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
        return self.input.frames > 1 or any(one.value != "speed" for one in self.inputs.values())


def read_description(path: Path) -> DescribedNetwork:
    """Read and check a description.

    Raises:
        DriverError: a key is invalid; one line names it and the allowed values.
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
        # pydantic reports a value of a union once for each member type.
        problems = {
            f"{'.'.join(str(part) for part in e['loc'] if not _is_kind(part)) or 'top level'}: "
            f"{e['msg'].removeprefix('Value error, ')}"
            for e in error.errors()
        }
        unknown = {".".join(map(str, e["loc"][:-1])) for e in error.errors() if e["type"] == "extra_forbidden"}
        models: dict[str, type[BaseModel]] = {"": DescribedNetwork, "input": InputSpec, "outputs": Outputs}
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
    """Return the path of the network file that a description, from `path`, names.

    Raises:
        DriverError: the file is missing, or of an unknown format.
    """
    file = path.parent / description.file
    refuse_weights_alone(file)
    if file.suffix.lower() not in KINDS or "\0" in description.file or len(description.file) > 4096:
        raise DriverError(
            f"{path}: file {description.file!r:.100}: expected {', '.join(KINDS)}; {GUIDE} says how to convert"
        )
    if not file.is_file():
        raise DriverError(f"{path}: file {description.file!r} is missing: its path is relative to {path.name}")
    return file


def refuse_weights_alone(file: Path) -> None:
    """Refuse a file of PyTorch's weights, which only its own program can load.

    Raises:
        DriverError: it is one; the sentence says how to export the network.
    """
    if file.suffix.lower() in WEIGHTS_ALONE:
        raise DriverError(
            f"{file} holds weights alone: in the program that defines the network, load them and export it with "
            f'torch.onnx.export(network.eval(), (torch.zeros(1, 3, ROWS, COLUMNS),), "{file.stem}.onnx", '
            f"dynamo=False), then `{ds_command('check', f'{file.stem}.onnx')}`"
        )


class DescribedNetworkPilot(Pilot):
    """Drives with a network file, from the path of its description, or as `described` in its place.

    Raises:
        DriverError: the description or the file cannot be used.
        BackendError: the backend cannot run the network.
    """

    def __init__(
        self, path: Path, backend: str = "auto", device: str = "cpu", described: DescribedNetwork | None = None
    ) -> None:
        self.description = described or read_description(path)
        self.sees_crop_only = self.description.input.crop == "simulator"
        self.has_memory = self.description.has_memory
        file = file_of(path, self.description)
        # The address space does not reflect the memory used on a GPU.
        self._bounded = nullcontext if device == "cuda" else limited_memory
        try:
            with self._bounded():
                self._runner = runner_of(file, backend, device, self._samples)
                self._place, self._given = _places(file.name, self._runner.inputs, self.description)
                self.start()
                self._check(file.name)
                self.start()
        except MemoryError:
            raise DriverError(f"{file.name} needs more memory than a network may take: make it smaller") from None

    def described_as(self, description: DescribedNetwork) -> DescribedNetworkPilot:
        """Return a pilot with the same loaded network, of the same input shape, and another description."""
        other = copy.copy(self)
        other.description = description
        return other

    def start(self) -> None:
        """Forget the images, commands and states of the run before."""
        spec = self.description.input
        self._memory = RunMemory(
            self._given,
            frames=spec.frames,
            stride=spec.stride,
            newest_first=spec.order == "newest_first",
            axis=spec.axis,
        )

    def predict(self, frame: Frame) -> Prediction:
        """See `ds_driver.networks.pilot.Pilot`."""
        outputs, spec = self.outputs(frame), self.description.outputs
        prediction = Prediction(
            self._number(outputs, "steering", spec.steering),
            None if spec.throttle is None else self._number(outputs, "throttle", spec.throttle),
        )
        states = {k: self._state(outputs, k) for k, (one, _) in self._given.items() if one.state is not None}
        self._memory.note(states, prediction.steering, prediction.throttle)
        return prediction

    @property
    def output_names(self) -> tuple[str, ...]:
        """Return the names of the outputs; () if the file has none."""
        return self._runner.outputs

    def outputs(self, frame: Frame) -> list[NDArray[np.float32]]:
        """Compute all outputs of the network for the next frame of a run."""
        inputs = self._memory.inputs(self.pixels(frame), self._place, frame.speed)
        with self._bounded():
            return self._runner.compute(*inputs)

    def seen(self, frame: Frame) -> NDArray[np.uint8]:
        """Return what the network sees of a frame, (rows, columns, channels) uint8, before pixels are scaled."""
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
        return image.reshape(*spec.size, -1)

    def pixels(self, frame: Frame) -> NDArray[Any]:
        """Convert the image of a frame to that of the network, scaled, in its layout."""
        spec = self.description.input
        pixels: NDArray[Any] = self.seen(frame)
        if spec.type == "float32":
            subtract, divide = (np.asarray(number, np.float32) for number in (spec.subtract, spec.divide))
            pixels = (pixels.astype(np.float32) - subtract) / divide
        if spec.layout == "nchw":
            pixels = pixels.transpose(2, 0, 1)
        return pixels

    def _samples(self) -> list[NDArray[Any]]:
        if self.description.inputs or self.description.has_memory:
            raise BackendError("8 bits are calibrated on single images: use another backend for this network")
        return [np.ascontiguousarray(self.pixels(frame)[None]) for frame in calibration_frames()]

    def _check(self, name: str) -> None:
        """Compare the file with the description, and warm up with a black image."""
        spec = self.description.input
        image = self._runner.inputs[self._place] if self._runner.inputs else NetworkInput()
        if image.shape is not None and not _fits(image.shape, spec.shape):
            raise DriverError(
                f"{name} expects an input of {_sizes(image.shape)}, its description gives {_sizes(spec.shape)}: "
                "correct size or layout"
            )
        if image.type and image.type != spec.type:
            raise DriverError(
                f"{name} expects input of type {image.type}, its description gives {spec.type}: correct type"
            )
        black = np.zeros((IMAGE_HEIGHT, IMAGE_WIDTH, 3), np.uint8)
        try:
            self.predict(Frame(image=black, speed=0.0))
        except DriverError as error:
            raise DriverError(f"{name} fails on a black image: {error}") from None

    def _output(self, outputs: list[NDArray[np.float32]], what: str, wanted: int | str) -> NDArray[np.float32]:
        names = self._runner.outputs
        if isinstance(wanted, str):
            if wanted not in names:
                known = ", ".join(name for name in names if name) or "none has a name, give its position"
                raise DriverError(f"there is no output {wanted!r} for {what}: expected one of {known}")
            return outputs[names.index(wanted)]
        if wanted >= len(outputs):
            raise DriverError(f"no output {wanted} for {what}: the network has {len(outputs)}, counted from 0")
        return outputs[wanted]

    def _state(self, outputs: list[NDArray[np.float32]], place: int) -> NDArray[np.float32]:
        spec, shape = self._given[place]
        assert spec.state is not None
        found = self._output(outputs, f"the state of input {place}", spec.state)
        if found.size != np.prod(shape):
            raise DriverError(
                f"output {spec.state!r} has {found.size} numbers, the input that it comes back in has "
                f"{int(np.prod(shape))}: name another output"
            )
        return found

    def _number(self, outputs: list[NDArray[np.float32]], what: str, spec: OutputSpec) -> float:
        found = self._output(outputs, what, spec.output)
        if spec.index >= found.size or (spec.bins and found.size < 2):
            raise DriverError(f"there is no index {spec.index} for {what}: the output has {found.size} numbers")
        return spec.value(found.reshape(-1))


def _places(
    name: str, inputs: Sequence[NetworkInput], described: DescribedNetwork
) -> tuple[int, dict[int, tuple[GivenInput, tuple[int, ...]]]]:
    """Find the position of the image, and of every other input with its shape.

    Raises:
        DriverError: file and description have other inputs.
    """
    known = [one.name for one in inputs]
    count = len(inputs) or 1 + len(described.inputs)

    def place_of(key: int | str) -> int:
        if isinstance(key, str) and key in known:
            return known.index(key)
        if isinstance(key, int) and key < count:
            return key
        expected = ", ".join(filter(None, known)) or f"its position, 0 to {count - 1}"
        raise DriverError(f"{name} has no input {key!r}: expected {expected}")

    given = {place_of(key): one for key, one in described.inputs.items()}
    free = [place for place in range(count) if place not in given]
    if len(free) != 1:
        named = ", ".join(one or f"number {place}" for place, one in enumerate(known))
        raise DriverError(
            f"{name} has {count} inputs ({named}), its description gives {1 + len(described.inputs)}: `input` is the "
            "image, and each other one stands in `inputs`, as `h: {state: OUTPUT}` or `speed: {value: speed}`"
        )
    shapes = {}
    for place, one in given.items():
        try:
            shapes[place] = one, one.shape_in(inputs[place].shape if inputs else None)
        except ValueError as error:
            raise DriverError(f"{name}, input {known[place] if known else place}: {error}") from None
        expected = inputs[place].shape if inputs else None
        if expected is not None and not _fits(expected, shapes[place][1]):
            raise DriverError(
                f"{name} expects {_sizes(expected)} as input {known[place] or place}, its description gives "
                f"{_sizes(shapes[place][1])}: correct shape"
            )
    return free[0], shapes


def _fits(expected: Sequence[int | None], given: Sequence[int]) -> bool:
    return len(expected) == len(given) and all(a in (None, b) for a, b in zip(expected, given, strict=True))


def _sizes(shape: Sequence[int | None]) -> str:
    return "x".join("any" if size is None else str(size) for size in shape)


def runner_of(file: Path, backend: str = "auto", device: str = "cpu", samples: Samples = lambda: []) -> Runner:
    """Load a network file, whatever its description says; see `DescribedNetworkPilot`."""
    kind = KINDS[file.suffix.lower()]
    possible = _BACKENDS_OF[kind]
    chosen = possible[0] if backend == "auto" else backend
    if chosen not in possible:
        expected = ", ".join(possible[:-1]) + f" or {possible[-1]}"
        raise BackendError(f"backend {chosen} cannot run {file.name}: expected {expected}")
    try:
        content = read_bounded(file, LARGEST_FILE)
    except (BoundedYamlError, OSError) as error:
        raise DriverError(f"{file} cannot be read ({getattr(error, 'strerror', None) or error})") from None
    if kind == "onnx":
        check_onnx(content, file.name)
    if chosen.startswith("openvino"):
        return openvino_runner(for_backend(chosen, content, file.name, samples), file.name, chosen, kind=kind)
    if chosen == "onnx":
        return onnx_runner(content, file.name)
    from ds_driver.networks.torch_networks import torch_device, torchscript_runner

    return torchscript_runner(content, torch_device(device), file.name)


def _is_kind(part: object) -> bool:
    """Check for the parts that pydantic adds to a path to name a member type of a union."""
    return isinstance(part, str) and (part in ("float", "int", "str", "Rows") or "[" in part)


class UserClassPilot(Pilot):
    """Wraps a class without constructor arguments, with a method `drive(frame)` and, if it has state, `start()`.

    `drive` takes a `Frame` and returns the steering, or a pair of steering and throttle.

    Raises:
        DriverError: the class cannot be imported or instantiated, or fails on a black image.
    """

    def __init__(self, target: str) -> None:
        kind = _find(target)
        self._target = target
        try:
            self._driver = kind()
        except Exception as error:
            raise DriverError(f"driver {target} cannot be created ({_describe(error)}): fix its __init__") from None
        if not callable(getattr(self._driver, "drive", None)):
            raise DriverError(f"driver {target} has no method drive(frame): see docs/bring_your_own_network.md")
        self.has_memory = hasattr(self._driver, "start")
        self.start()
        self.predict(Frame(image=np.zeros((IMAGE_HEIGHT, IMAGE_WIDTH, 3), np.uint8), speed=0.0))
        self.start()

    def start(self) -> None:
        """Call `start` of the class, if it has one, at the start of a run."""
        start = getattr(self._driver, "start", None)
        if start is not None:
            try:
                start()
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
            return Prediction(float(steering), None if throttle is None else float(throttle))
        except (TypeError, ValueError) as error:
            if isinstance(error, DriverError):
                raise
            raise DriverError(
                f"{self._target}.drive returned {answer!r:.60}: expected the steering, or steering and throttle"
            ) from None


def source_of(target: str) -> Path:
    """Return the source file of a class.

    Raises:
        DriverError: the class cannot be imported, or comes from no file.
    """
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
