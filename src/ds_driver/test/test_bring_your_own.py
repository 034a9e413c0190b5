# SPDX-License-Identifier: Apache-2.0
"""User-provided networks: described files and classes, valid and invalid, and files of strangers in any format."""

from __future__ import annotations

import pickle
import re
import resource
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnx
import pytest
import torch
import yaml
from installed_package import installed_package
from made_networks import write_graph
from onnx import TensorProto, helper, numpy_helper
from torch import nn

from ds_driver.closed_loop.simulation import drive_road, make_driver
from ds_driver.control.autopilot import throttle
from ds_driver.networks.described_network import DescribedNetworkPilot
from ds_driver.networks.description import DescribedNetwork, Outputs
from ds_driver.networks.driver_name import DriverName, received_driver
from ds_driver.networks.images import Crop
from ds_driver.networks.network_driver import NetworkDriver, driver_sha256
from ds_driver.networks.network_file import refuse_foreign, runner_of
from ds_driver.networks.pilot import DriverError, Frame
from ds_road import generate
from ds_sim.registry import make_simulator
from ds_sim.simulator import Outcome

# PyTorch deprecates TorchScript, but users still have such files.
pytestmark = pytest.mark.filterwarnings(
    "ignore:.torch.jit:DeprecationWarning",
    "ignore:.*legacy TorchScript:DeprecationWarning",
    "ignore:The feature will be removed:DeprecationWarning",
)

GUIDE = (Path(__file__).resolve().parents[3] / "docs/bring_your_own_network.md").read_text()
IMAGE = np.random.default_rng(5).integers(0, 256, (160, 320, 3), dtype=np.uint8)
GENTLE = generate(np.random.default_rng(2), max_angle=30)


class Linear(nn.Module):
    """Donkey Car's `linear` pilot (donkeycar 4.5, KerasLinear on its core CNN layers, without dropout)."""

    def __init__(self) -> None:
        super().__init__()
        sizes = [(3, 24, 5, 2), (24, 32, 5, 2), (32, 64, 5, 2), (64, 64, 3, 1), (64, 64, 3, 1)]
        convolutions = [part for i, o, k, s in sizes for part in (nn.Conv2d(i, o, k, stride=s), nn.ReLU())]
        self.see = nn.Sequential(*convolutions)
        self.think = nn.Sequential(nn.Linear(6656, 100), nn.ReLU(), nn.Linear(100, 50), nn.ReLU())
        self.angle, self.throttle = nn.Linear(50, 1), nn.Linear(50, 1)

    def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        x = self.see(image.permute(0, 3, 1, 2))
        x = self.think(x.permute(0, 2, 3, 1).flatten(1))  # Keras flattens with channels last
        return self.angle(x), self.throttle(x)

    def to_onnx(self, path: Path) -> None:
        """Write the graph with a free batch size, channels last and Keras's output names."""
        torch.onnx.export(
            self,
            (torch.zeros(1, 120, 160, 3),),
            str(path),
            input_names=["img_in"],
            output_names=["n_outputs0", "n_outputs1"],
            dynamic_axes={"img_in": {0: "any"}},
            dynamo=False,
        )


@pytest.fixture
def linear() -> Linear:
    torch.manual_seed(4)
    network = Linear().eval().requires_grad_(False)
    network.throttle.bias.fill_(0.4)  # a throttle within both bounds
    return network


def examples(heading: str) -> list[str]:
    return re.findall(rf"```{heading}\n(.*?)```", GUIDE, re.DOTALL)


def donkey(file: str, steering: str | int, throttle: str | int) -> dict[str, Any]:
    return {
        "file": file,
        "input": {"size": [120, 160], "layout": "nhwc", "divide": 255},
        "outputs": {"steering": {"output": steering}, "throttle": {"output": throttle}},
    }


def test_a_donkey_car_pilot_drives_on_every_backend(tmp_path: Path, linear: Linear) -> None:
    """In ONNX and TorchScript, on every possible backend: the command equals PyTorch's for the resized image."""
    small = cv2.resize(IMAGE, (160, 120), interpolation=cv2.INTER_LINEAR).astype(np.float32) / 255
    angle, power = (float(part) for part in linear(torch.from_numpy(small)[None]))
    assert 0.01 < abs(angle) < 1.0 and 0.05 < power < 1.0
    linear.to_onnx(tmp_path / "mypilot.onnx")
    torch.jit.trace(linear, torch.zeros(1, 120, 160, 3)).save(str(tmp_path / "mypilot.pt"))
    frame = Frame(image=IMAGE, speed=3.0, crop=Crop(40, 0))
    for described in (donkey("mypilot.onnx", "n_outputs0", "n_outputs1"), donkey("mypilot.pt", 0, 1)):
        (tmp_path / "p.yaml").write_text(yaml.safe_dump(described))
        for backend in ("auto", "openvino"):
            command = NetworkDriver(f"{tmp_path / 'p.yaml'}@{backend}").command(frame)
            assert (command.steering, command.throttle) == pytest.approx((angle, power), abs=1e-5), (described, backend)


def test_a_donkey_car_pilot_in_tensorflow_lite_agrees_with_tensorflow(tmp_path: Path) -> None:
    """`data/donkey_pilot.tflite`: Keras's `linear` with two narrow convolutions, converted by TensorFlow 2.21.

    The expected numbers come from TensorFlow's interpreter for the same resized image. The converter has changed the
    order of the outputs.
    """
    described = donkey("mypilot.tflite", "StatefulPartitionedCall_1:0", "StatefulPartitionedCall_1:1")
    (tmp_path / "mypilot.tflite").write_bytes((Path(__file__).parent / "data" / "donkey_pilot.tflite").read_bytes())
    (tmp_path / "p.yaml").write_text(yaml.safe_dump(described))
    command = NetworkDriver(str(tmp_path / "p.yaml")).command(Frame(image=IMAGE, speed=3.0, crop=Crop(40, 0)))
    assert (command.steering, command.throttle) == pytest.approx((-0.243504, 0.731181), abs=1e-5)
    (tmp_path / "mypilot.tflite").write_bytes(b"not a network")
    with pytest.raises(DriverError, match="mypilot.tflite cannot be run by OpenVINO"):
        DescribedNetworkPilot(tmp_path / "p.yaml")


class Pixel(nn.Module):
    """Returns one value of its input, to test the preprocessing."""

    def __init__(self, *place: int) -> None:
        super().__init__()
        self.place = place

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        found = image[0]
        for index in self.place:
            found = found[index]
        return torch.stack([found.float(), -found.float()])


def written(folder: Path, network: nn.Module, shape: tuple[int, ...], **described: Any) -> Path:
    torch.jit.trace(network, torch.zeros(shape)).save(str(folder / "n.pt"))
    (folder / "n.yaml").write_text(yaml.safe_dump({"file": "n.pt"} | described))
    return folder / "n.yaml"


RED, GREEN, BLUE = 200.0, 100.0, 50.0
LUMA = 0.299 * RED + 0.587 * GREEN + 0.114 * BLUE  # BT.601


@pytest.mark.parametrize(
    ("keys", "place", "expected"),
    [
        ({"colour": "rgb"}, (0, 4, 4), RED),
        ({"colour": "bgr"}, (0, 4, 4), BLUE),
        ({"colour": "bgr", "layout": "nhwc"}, (4, 4, 2), RED),
        ({"colour": "yuv"}, (0, 4, 4), LUMA),
        ({"colour": "grey"}, (0, 4, 4), LUMA),
        ({"colour": "grey", "layout": "nhwc"}, (4, 4, 0), LUMA),
        ({"subtract": 127.5, "divide": 127.5}, (1, 4, 4), GREEN / 127.5 - 1),
        ({"subtract": [1, 2, 3], "divide": [4, 5, 6]}, (2, 4, 4), (BLUE - 3) / 6),
        ({"subtract": [1, 2, 3], "divide": [4, 5, 6], "layout": "nhwc"}, (4, 4, 1), (GREEN - 2) / 5),
        ({"type": "uint8"}, (0, 4, 4), RED),
    ],
)
def test_colours_layouts_and_normalisation(
    tmp_path: Path, keys: dict[str, Any], place: tuple[int, ...], expected: float
) -> None:
    image = np.full((160, 320, 3), (RED, GREEN, BLUE), np.uint8)
    layout, channels = keys.get("layout", "nchw"), 1 if keys.get("colour") == "grey" else 3
    shape = (1, channels, 8, 16) if layout == "nchw" else (1, 8, 16, channels)
    path = written(tmp_path, Pixel(*place), shape, input={"size": [8, 16], **keys})
    found = DescribedNetworkPilot(path).predict(Frame(image=image, speed=1.0))
    assert found.steering == pytest.approx(expected, abs=0.6 if channels == 1 or "colour" in keys else 1e-5)
    assert found.throttle is None


@pytest.mark.parametrize(
    ("crop", "first", "last"), [("none", 0, 159), ("simulator", 54, 158), ({"top": 10, "bottom": 30}, 10, 129)]
)
def test_crops(tmp_path: Path, crop: object, first: int, last: int) -> None:
    """Each row holds its number as its value; the input has the height of the cropped image, so nothing is resized."""
    rows = np.broadcast_to(np.arange(160, dtype=np.uint8)[:, None, None], (160, 320, 3))
    high = last - first + 1
    for place, expected in ((0, first), (high - 1, last)):
        network = Pixel(0, place, 7)
        path = written(tmp_path, network, (1, 3, high, 320), input={"size": [high, 320], "crop": crop})
        assert DescribedNetworkPilot(path).predict(Frame(image=rows, speed=0.0, crop=Crop(54, 1))).steering == expected


def test_outputs_are_chosen_and_scaled(tmp_path: Path) -> None:
    """Degrees to the left, up to 25, as the second value of an output."""
    image = np.full((160, 320, 3), 10, np.uint8)
    outputs = {"steering": {"index": 1, "scale": 0.04}, "throttle": {"scale": 0.01, "offset": 0.2}}
    path = written(tmp_path, Pixel(0, 0, 0), (1, 3, 8, 16), input={"size": [8, 16]}, outputs=outputs)
    command = NetworkDriver(str(path)).command(Frame(image=image, speed=5.0))
    assert (command.steering, command.throttle) == pytest.approx((-10 * 0.04, 10 * 0.01 + 0.2))


def test_throttle_defaults_to_equation_2_and_steering_is_clipped(tmp_path: Path) -> None:
    path = written(tmp_path, Pixel(0, 0, 0), (1, 3, 8, 16), input={"size": [8, 16], "divide": 100})
    driver = NetworkDriver(str(path))
    half, full = (driver.command(Frame(image=np.full((160, 320, 3), v, np.uint8), speed=5.0)) for v in (50, 250))
    assert half.steering == 0.5 and half.throttle == throttle(0.5, 5.0)
    assert full.steering == 1.0


def altered(described: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """The description with these keys, also within its parts."""
    parts = {key: altered(described[key], of) for key, of in changes.items() if isinstance(described.get(key), dict)}
    return described | changes | parts


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"output": 1}, r"output: Extra inputs.*keys of the file: file, input, inputs, outputs"),
        ({"input": {"color": "rgb"}}, r"input\.color: Extra inputs.*keys of input: size, colour, layout"),
        ({"input": {"colour": "hsv"}}, "input.colour: Input should be 'rgb', 'bgr', 'yuv' or 'grey'"),
        ({"input": {"size": [0, 160]}}, r"input\.size\.0: Input should be greater than or equal to 1"),
        ({"input": {"divide": 0}}, "divide is 0"),
        ({"input": {"crop": {"top": 100, "bottom": 59}}}, "leaves nothing to see"),
        ({"input": {"type": "uint8"}}, "leave out subtract and divide"),
        ({"input": {"size": [160, 120]}}, "an input of anyx120x160x3, its description gives 1x160x120x3"),
        ({"input": {"layout": "nchw"}}, "its description gives 1x3x120x160: correct size or layout"),
        ({"outputs": {"steering": {"output": "angle"}}}, "no output 'angle'.*one of n_outputs0, n_outputs1"),
        ({"outputs": {"steering": {"output": 2}}}, "no output 2 for steering: the network has 2, counted"),
        ({"outputs": {"steering": {"index": 1}}}, "output for steering has 1 numbers: its description needs 2"),
        ({"outputs": {"steering": {"scale": float("inf")}}}, r"outputs\.steering\.scale: .*finite number"),
        ({"file": "gone.onnx"}, "'gone.onnx' is missing: its path is relative to p.yaml"),
        ({"file": "pilot.h5"}, r"expected \.onnx, \.pt.*says how to convert"),
        ({"file": "cut.onnx"}, "cut.onnx cannot be loaded"),
        (
            {"file": "weights.pt"},
            r"weights.pt holds PyTorch weights alone: .*torch\.onnx\.export.*ds check weights\.onnx",
        ),
    ],
)
def test_invalid_descriptions_are_refused_in_one_line(
    tmp_path: Path, linear: Linear, changes: dict[str, Any], said: str
) -> None:
    linear.to_onnx(tmp_path / "mypilot.onnx")
    (tmp_path / "cut.onnx").write_bytes((tmp_path / "mypilot.onnx").read_bytes()[:5000])
    torch.save(linear.state_dict(), tmp_path / "weights.pt")
    described = altered(donkey("mypilot.onnx", "n_outputs0", "n_outputs1"), changes)
    (tmp_path / "p.yaml").write_text(yaml.safe_dump(described))
    with pytest.raises(DriverError, match=said) as refused:
        NetworkDriver(str(tmp_path / "p.yaml"))
    assert "\n" not in str(refused.value) and len(str(refused.value)) < 500


def test_wrong_types_and_inputs_are_refused(tmp_path: Path) -> None:
    def save(*inputs: str, kind: int = TensorProto.FLOAT) -> str:
        nodes, shape = [helper.make_node("Cast", ["i0"], ["o"], to=TensorProto.FLOAT)], [1, 3, 8, 16]
        write_graph(tmp_path / "n.onnx", nodes, dict.fromkeys(inputs, shape), {"o": shape}, kind=kind)
        (tmp_path / "n.yaml").write_text("file: n.onnx\ninput: {size: [8, 16]}")
        return str(tmp_path / "n.yaml")

    with pytest.raises(DriverError, match="expects input of type uint8, its description gives float32: correct type"):
        NetworkDriver(save("i0", kind=TensorProto.UINT8))
    with pytest.raises(DriverError, match=r"has 2 inputs \(i0, i1\), its description gives 1: .*{state: OUTPUT}"):
        NetworkDriver(save("i0", "i1"))
    with pytest.raises(DriverError, match=r"torch cannot run n\.onnx: expected onnx, openvino or openvino-bf16"):
        NetworkDriver(save("i0") + "@torch")
    with pytest.raises(DriverError, match=r"ds check .* writes one"):
        NetworkDriver(str(tmp_path / "n.onnx"))


def test_the_guides_descriptions_are_valid() -> None:
    found = [DescribedNetwork.model_validate(yaml.safe_load(text)) for text in examples("yaml")]
    assert [f.file for f in found] == ["my_net.onnx", "recurrent.onnx"]
    table = GUIDE[GUIDE.index("### What it answers") : GUIDE.index("A value is `scale` times")]
    rows = [line.split("|")[2] for line in table.splitlines()[3:] if line]
    for row in rows:
        outputs = {k: v for text in re.findall(r"`(\w+: \{.*?\})`", row) for k, v in yaml.safe_load(text).items()}
        assert outputs and Outputs.model_validate(outputs)
    assert len(rows) == 10


WriteModule = Callable[[str], str]


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> WriteModule:
    monkeypatch.syspath_prepend(tmp_path)
    numbers = iter(range(100))

    def write(text: str) -> str:
        name = f"brought_{tmp_path.name.replace('-', '_')}_{next(numbers)}"
        (tmp_path / f"{name}.py").write_text(text)
        return name

    return write


def test_the_guides_class_drives_a_gentle_road_to_its_end(module: WriteModule) -> None:
    name = module(next(text for text in examples("python") if "class MyDriver" in text))
    simulator = make_simulator("bullet")
    run = drive_road(simulator, make_driver(f"{name}:MyDriver", simulator.spec), GENTLE, seed=1)
    assert run.outcome is Outcome.COMPLETED and {c.throttle for c in run.commands} == {0.3}


COUNTER = """
class Counter:
    def __init__(self):
        self.frames = 10
    def start(self):
        self.frames = 0
    def drive(self, frame):
        self.frames += 1
        return self.frames / 1000
"""


def test_start_is_called_at_the_beginning_of_each_run(module: WriteModule) -> None:
    simulator = make_simulator("donkey")
    driver = make_driver(f"{module(COUNTER)}:Counter", simulator.spec)
    runs = [drive_road(simulator, driver, GENTLE, seed=1) for _ in range(2)]
    assert runs[0].commands == runs[1].commands
    assert [c.steering for c in runs[0].commands[:3]] == [0.001, 0.002, 0.003]


def test_the_driver_of_an_installed_package_goes_by_its_name(module: WriteModule, tmp_path: Path) -> None:
    name = module("class Left:\n    def drive(self, frame): return -0.5\n")
    with installed_package(tmp_path, "drivers", {"left": f"{name}:Left"}):
        assert NetworkDriver("left").command(Frame.black()).steering == -0.5
        driver = DriverName("left")
        assert driver_sha256(driver) == driver_sha256(DriverName(f"{name}:Left")) and received_driver(driver) == driver


FAULTY = """
class Silent: pass
class Broken:
    def __init__(self): raise RuntimeError("no camera")
class Wordy:
    def drive(self, frame): return "left"
class Late:
    def drive(self, frame): return float("nan") if frame.step == 5 else 0.0
class Sudden:
    def drive(self, frame): return [0.0][frame.step // 5]
"""


@pytest.mark.parametrize(
    ("target", "said"),
    [
        ("Silent", "has no method drive"),
        ("Broken", "cannot be created .RuntimeError: no camera."),
        ("Wordy", "returned 'left': expected the steering, or steering and throttle"),
        ("Missing", "cannot be imported .AttributeError"),
    ],
)
def test_classes_that_cannot_drive_are_refused(module: WriteModule, target: str, said: str) -> None:
    with pytest.raises(DriverError, match=said):
        NetworkDriver(f"{module(FAULTY)}:{target}")
    with pytest.raises(DriverError, match="cannot be imported .ModuleNotFoundError"):
        NetworkDriver("nowhere_at_all:Driver")


@pytest.mark.parametrize(
    ("target", "said"), [("Late", "the network's steering is nan"), ("Sudden", "drive failed (IndexError")]
)
def test_a_driver_without_a_valid_answer_is_an_error_not_a_failure(module: WriteModule, target: str, said: str) -> None:
    simulator = make_simulator("donkey")
    run = drive_road(simulator, make_driver(f"{module(FAULTY)}:{target}", simulator.spec), GENTLE, seed=1)
    assert run.outcome is Outcome.DRIVER_SILENT and run.outcome.is_error and said in run.message
    assert run.steps == 5


def test_a_drivers_hash_covers_description_file_and_class(tmp_path: Path, linear: Linear, module: WriteModule) -> None:
    linear.to_onnx(tmp_path / "mypilot.onnx")
    text = yaml.safe_dump(donkey("mypilot.onnx", "n_outputs0", "n_outputs1"))
    path = tmp_path / "p.yaml"

    def hash_with(content: str) -> str:
        path.write_text(content)
        return driver_sha256(DriverName.parse(f"{path}@openvino"))

    first, other, again = hash_with(text), hash_with(text + "\n# changed"), hash_with(text)
    assert first == again != other
    with (tmp_path / "mypilot.onnx").open("ab") as file:
        file.write(b"\0")
    assert hash_with(text) != first
    counter, late = DriverName(f"{module(COUNTER)}:Counter"), DriverName(f"{module(FAULTY)}:Late")
    assert driver_sha256(counter) != driver_sha256(late)


class Bomb:
    """Leaves a file behind if it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return (open, ("ran", "w"))


def keras(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        for member in ("metadata.json", "config.json", "model.weights.h5"):
            archive.writestr(member, b"{}")


def holding(content: bytes) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        path.write_bytes(content)

    return write


def tflite(operations: bytes) -> Callable[[Path], None]:
    """Write the beginning of a TensorFlow Lite file and names of operations, as its flatbuffer holds them."""
    return holding(b"\x1c\0\0\0TFL3" + bytes(40) + operations + bytes(40))


def saved(network: Any, *, old: bool = False) -> Callable[[Path], None]:
    return lambda path: torch.save(network, path, _use_new_zipfile_serialization=not old)


LINEAR = torch.nn.Linear(3, 1)
HDF5 = b"\x89HDF\r\n\x1a\n"


@pytest.mark.parametrize(
    ("name", "write", "said"),
    [
        (
            "n.pt",
            saved(LINEAR),
            r"whole PyTorch model.*names Linear of torch\.nn\.modules\.linear.*torch\.onnx\.export",
        ),
        ("n.pth", saved(LINEAR, old=True), r"whole PyTorch model.*names Linear of torch\.nn.*ds check n\.onnx"),
        ("n.pth", saved(LINEAR.state_dict()), r"holds PyTorch weights alone: .*torch\.onnx\.export.*ds check n\.onnx"),
        ("n.pt", saved({"model": LINEAR.state_dict(), "epoch": 3}), "holds PyTorch weights alone"),
        ("n.ckpt", saved(LINEAR.state_dict(), old=True), "holds PyTorch weights alone"),
        ("n.pt", saved(Bomb()), r"whole PyTorch model.*names open of"),
        ("n.h5", holding(HDF5 + b"..model_config.."), r"whole Keras model.*--keras \S*n\.h5 --output n"),
        ("n.h5", holding(HDF5), r"weights alone in Keras's HDF5.*load_weights"),
        ("n.onnx", holding(HDF5 + b"model_config"), "n.onnx is a whole Keras model in HDF5"),
        ("n.keras", keras, r"n\.keras is a whole Keras model: .*export\('n\.onnx', format='onnx'\)"),
        ("n.tflite", tflite(b"FlexConv3D\0FlexRelu\0"), r"only TensorFlow runs \(FlexConv3D, FlexRelu\).*tf2onnx"),
        ("n.pkl", holding(pickle.dumps(Bomb())), "is a Python pickle, which is a program"),
        ("n.trt", holding(b"ftrt"), "TensorRT engine, built for one GPU"),
        ("n.pt", holding(b"PK\x03\x04" + bytes(50)), "whose end is missing or damaged: copy it again"),
    ],
)
def test_the_first_line_says_what_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, write: Callable[[Path], None], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    write(tmp_path / name)
    (tmp_path / "n.yaml").write_text(f"file: {name}\ninput: {{size: [8, 16]}}")
    for driver in (name, "n.yaml"):
        with pytest.raises(DriverError, match=said) as refused:
            NetworkDriver(driver)
        text = str(refused.value)
        assert text.startswith(name) and "\n" not in text and "whole ONNX" not in text
    assert not Path("ran").exists()


def test_a_saved_model_is_a_folder(tmp_path: Path) -> None:
    (tmp_path / "pilot.savedmodel").mkdir()
    (tmp_path / "pilot.savedmodel/saved_model.pb").touch()
    with pytest.raises(DriverError, match=r"is a SavedModel of TensorFlow: .*--saved-model \S+ --output pilot\.onnx"):
        refuse_foreign(tmp_path / "pilot.savedmodel")


def test_what_runs_is_not_refused_and_a_wrong_name_is_told(tmp_path: Path) -> None:
    torch.jit.trace(LINEAR, torch.zeros(1, 3)).save(tmp_path / "n.pt")  # type: ignore[no-untyped-call]
    tflite(b"CONV_2D\0")(tmp_path / "n.tflite")
    for name in ("n.pt", "n.tflite", "gone.pt"):
        refuse_foreign(tmp_path / name)
    (tmp_path / "n.onnx").write_bytes((tmp_path / "n.pt").read_bytes())
    with pytest.raises(DriverError, match=r"n\.onnx is a TorchScript file: rename it to n\.pt"):
        runner_of(tmp_path / "n.onnx", "onnx")


def described(folder: Path, nodes: list[onnx.NodeProto], constants: list[onnx.TensorProto]) -> Path:
    write_graph(folder / "network.onnx", nodes, {"image": [1, 3, 160, 320]}, {"out": None}, constants)
    (folder / "network.yaml").write_text("file: network.onnx\ninput: {size: [160, 320]}\n")
    return folder / "network.yaml"


def test_a_constant_of_gigabytes_is_refused(tmp_path: Path) -> None:
    shape = numpy_helper.from_array(np.array([3_000_000_000], np.int64), "shape")
    nodes = [
        helper.make_node("ConstantOfShape", ["shape"], ["constant"]),
        helper.make_node("ReduceMean", ["constant"], ["mean"], keepdims=0),
        helper.make_node("ReduceMean", ["image"], ["value"], keepdims=0),
        helper.make_node("Add", ["mean", "value"], ["out"]),
    ]
    before = resource.getrlimit(resource.RLIMIT_AS)
    with pytest.raises(DriverError) as refused:
        DescribedNetworkPilot(described(tmp_path, nodes, [shape]))
    assert "\n" not in str(refused.value) and resource.getrlimit(resource.RLIMIT_AS) == before


def test_external_data_is_refused_also_within_a_subgraph(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "weight.bin").write_bytes(bytes(4))
    weight = TensorProto(name="weight", data_type=TensorProto.FLOAT, dims=[1], data_location=TensorProto.EXTERNAL)
    weight.external_data.add(key="location", value="weight.bin")
    mean = helper.make_node("ReduceMean", ["image"], ["value"], keepdims=0)
    product = [mean, helper.make_node("Mul", ["value", "weight"], ["out"])]
    inner = helper.make_graph(
        [helper.make_node("Constant", [], ["inside"], value=weight)],
        "inner",
        [],
        [helper.make_tensor_value_info("inside", TensorProto.FLOAT, [1])],
    )
    choice = [
        helper.make_node("Constant", [], ["yes"], value=numpy_helper.from_array(np.array(True))),
        helper.make_node("If", ["yes"], ["out"], then_branch=inner, else_branch=inner),
    ]
    for nodes, constants in ((product, [weight]), (choice, [])):
        with pytest.raises(DriverError, match="keeps its weights in other files"):
            DescribedNetworkPilot(described(tmp_path, nodes, constants))


def test_a_torchscript_program_that_fails_is_refused_in_one_line(tmp_path: Path) -> None:
    class Fails(torch.nn.Module):
        def forward(self, image: torch.Tensor) -> torch.Tensor:
            steering = [1.0]
            return image.mean() * steering[5]

    torch.jit.script(Fails()).save(str(tmp_path / "network.pt"))
    (tmp_path / "network.yaml").write_text("file: network.pt\ninput: {size: [160, 320]}\n")
    with pytest.raises(DriverError, match=r"fails on a black image: .*index out of range"):
        DescribedNetworkPilot(tmp_path / "network.yaml")
