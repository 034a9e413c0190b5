# SPDX-License-Identifier: Apache-2.0
"""Described networks: several inputs, stacks of frames, states, angles, paths, by PyTorch and closed forms."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import yaml
from torch import nn

from ds_driver.closed_loop.simulation import drive_road, make_driver
from ds_driver.control.bicycle import Geometry, pursuit_curvature
from ds_driver.networks.described_network import DescribedNetworkPilot
from ds_driver.networks.description import OutputSpec, PathSpec
from ds_driver.networks.pilot import DriverError, Frame
from ds_road import generate
from ds_sim.registry import STANDARD, make_simulator, spec_of
from ds_sim.run_codec import encode_run

pytestmark = pytest.mark.filterwarnings(
    "ignore:.torch.jit:DeprecationWarning", "ignore:.*legacy TorchScript:DeprecationWarning"
)

SIZE = (40, 80)
FRAMES = [
    Frame(image=image, speed=float(step), step=step)
    for step, image in enumerate(np.random.default_rng(3).integers(0, 256, (9, 160, 320, 3), dtype=np.uint8))
]


class Recurrent(nn.Module):
    """Convolution, LSTM cell, steering: the shape of a small recurrent pilot."""

    def __init__(self) -> None:
        super().__init__()
        self.see = nn.Conv2d(3, 4, 5, stride=4)
        self.cell = nn.LSTMCell(4 * 9 * 19, 8)
        self.steer = nn.Linear(8, 1)

    def forward(self, image: torch.Tensor, h: torch.Tensor, c: torch.Tensor) -> tuple[torch.Tensor, ...]:
        h, c = self.cell(torch.relu(self.see(image)).flatten(1), (h, c))
        return self.steer(h), h, c


def stacked() -> nn.Module:
    """Three images as nine channels."""
    return nn.Sequential(nn.Conv2d(9, 4, 5, stride=4), nn.ReLU(), nn.Flatten(), nn.Linear(4 * 9 * 19, 1))


class ChannelsFirst(nn.Module):
    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return images.permute(0, 4, 1, 2, 3)


def sequence() -> nn.Module:
    """Four images along an axis of time, channels last, as Donkey Car's `3d` and `rnn` pilots take them."""
    see = nn.Conv3d(3, 4, (2, 5, 5), stride=(1, 4, 4))
    return nn.Sequential(ChannelsFirst(), see, nn.ReLU(), nn.Flatten(), nn.Linear(4 * 3 * 9 * 19, 1))


class Remembering(nn.Module):
    """Image, the last three commands and the speed, as Donkey Car's `memory` pilot; steering and throttle."""

    def __init__(self) -> None:
        super().__init__()
        self.see = nn.Linear(3, 4)
        self.decide = nn.Linear(4 + 6 + 1, 2)

    def forward(self, image: torch.Tensor, mem: torch.Tensor, speed: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        found = self.decide(torch.cat([self.see(image.mean((2, 3))), mem, speed], 1))
        return found[:, :1], found[:, 1:]


def network(kind: Callable[[], nn.Module]) -> nn.Module:
    torch.manual_seed(1)
    return kind().eval().requires_grad_(False)


def written(
    folder: Path, made: nn.Module, taken: dict[str, tuple[int, ...]], answered: list[str], **described: Any
) -> Path:
    zeros, names = tuple(torch.zeros(shape) for shape in taken.values()), list(taken)
    torch.onnx.export(made, zeros, str(folder / "net.onnx"), input_names=names, output_names=answered, dynamo=False)
    image = {"size": list(SIZE), "divide": 255.0, **described.pop("input", {})}
    path = folder / "net.yaml"
    path.write_text(yaml.safe_dump({"file": "net.onnx", "input": image, **described}))
    return path


def seen(frame: Frame) -> torch.Tensor:
    small = cv2.resize(frame.image, SIZE[::-1], interpolation=cv2.INTER_LINEAR)
    return torch.from_numpy(small.transpose(2, 0, 1)[None].astype(np.float32) / np.float32(255.0))


def answers(pilot: DescribedNetworkPilot) -> list[float]:
    pilot.start()
    return [pilot.predict(frame).steering for frame in FRAMES]


RECURRENT = {"inputs": {"h": {"state": "h_out"}, "c": {"state": "c_out", "start": 0.5}}}
SHAPES = {"image": (1, 3, *SIZE), "h": (1, 8), "c": (1, 8)}


def recurrent(folder: Path, **described: Any) -> tuple[nn.Module, Path]:
    made = network(Recurrent)
    return made, written(folder, made, SHAPES, ["steering", "h_out", "c_out"], **described)


@pytest.mark.parametrize("backend", ["onnx", "openvino"])
def test_a_state_comes_back_in_the_next_frame_and_begins_afresh_with_a_run(tmp_path: Path, backend: str) -> None:
    if backend == "openvino":
        pytest.importorskip("openvino")
    made, path = recurrent(tmp_path, **RECURRENT)
    h, c, expected = torch.zeros(1, 8), torch.full((1, 8), 0.5), []
    for frame in FRAMES:
        steering, h, c = made(seen(frame), h, c)
        expected.append(float(steering))
    pilot = DescribedNetworkPilot(path, backend)
    first = answers(pilot)
    assert first == pytest.approx(expected, abs=1e-5) and len(set(np.round(first, 4))) > 5
    assert answers(pilot) == first


def test_a_traced_network_has_inputs_by_position(tmp_path: Path) -> None:
    made, path = recurrent(tmp_path, **RECURRENT)
    named = DescribedNetworkPilot(path)
    torch.jit.trace(made, tuple(torch.zeros(shape) for shape in SHAPES.values())).save(tmp_path / "net.pt")
    states = {1: {"state": 1, "shape": [1, 8]}, 2: {"state": 2, "shape": [1, 8], "start": 0.5}}
    described = {**yaml.safe_load(path.read_text()), "file": "net.pt", "inputs": states}
    path.write_text(yaml.safe_dump(described))
    assert answers(DescribedNetworkPilot(path)) == pytest.approx(answers(named), abs=1e-5)


@pytest.mark.parametrize("order", ["oldest_first", "newest_first"])
def test_a_stack_holds_frames_a_stride_apart_and_begins_with_the_first(tmp_path: Path, order: str) -> None:
    made = network(stacked)
    stack = {"frames": 3, "stride": 2, "order": order}
    path = written(tmp_path, made, {"image": (1, 9, *SIZE)}, ["steering"], input=stack)
    expected = []
    for step in range(len(FRAMES)):
        back = [FRAMES[max(step - k, 0)] for k in (4, 2, 0)]
        pixels = torch.cat([seen(one) for one in (back if order == "oldest_first" else reversed(back))], 1)
        expected.append(float(made(pixels)))
    assert answers(DescribedNetworkPilot(path)) == pytest.approx(expected, abs=1e-5)


def test_time_is_an_axis_of_its_own(tmp_path: Path) -> None:
    made = network(sequence)
    described = {"frames": 4, "stacked": "time", "layout": "nhwc"}
    path = written(tmp_path, made, {"image": (1, 4, *SIZE, 3)}, ["steering"], input=described)
    expected = []
    for step in range(len(FRAMES)):
        back = [seen(FRAMES[max(step - k, 0)]).permute(0, 2, 3, 1) for k in (3, 2, 1, 0)]
        expected.append(float(made(torch.stack(back, 1))))
    assert answers(DescribedNetworkPilot(path)) == pytest.approx(expected, abs=1e-5)


def test_commands_and_speed_are_given(tmp_path: Path) -> None:
    made = network(Remembering)
    given = {"mem": {"value": "commands", "last": 3}, "speed": {"value": "speed", "scale": 0.1}}
    outputs = {"steering": {"output": "angle"}, "throttle": {"output": "gas"}}
    shapes = {"image": (1, 3, *SIZE), "mem": (1, 6), "speed": (1, 1)}
    path = written(tmp_path, made, shapes, ["angle", "gas"], inputs=given, outputs=outputs)
    memory, expected = torch.zeros(1, 6), []
    for frame in FRAMES:
        angle, gas = made(seen(frame), memory, torch.full((1, 1), 0.1 * frame.speed))
        memory = torch.cat([memory[:, 2:], angle, gas], 1)
        expected.append(float(angle))
    assert answers(DescribedNetworkPilot(path)) == pytest.approx(expected, abs=1e-4)


def test_runs_of_one_process_share_no_state(tmp_path: Path) -> None:
    _, path = recurrent(tmp_path, **RECURRENT)
    simulator = make_simulator("softbody")
    driver = make_driver(str(path), simulator.spec)
    one, other = generate(np.random.default_rng(4)), generate(np.random.default_rng(5))
    first = encode_run(drive_road(simulator, driver, one, 1))
    drive_road(simulator, driver, other, 2)
    assert encode_run(drive_road(simulator, driver, one, 1)) == first
    simulator.close()


def h_is(**described: Any) -> dict[str, Any]:
    return {"inputs": {"h": described, "c": {"state": "c_out"}}}


@pytest.mark.parametrize(
    ("described", "said"),
    [
        ({}, r"has 3 inputs \(image, h, c\), its description gives 1: `input` is the image"),
        ({"inputs": {"h": {"state": "h_out"}}}, "its description gives 2"),
        (h_is(state="gone"), "there is no output 'gone' for the state"),
        (h_is(state="steering"), "has 1 numbers, the input that it comes back"),
        (h_is(state="h_out", shape=[1, 9]), "expects 1x8 as input h"),
        (h_is(state="h_out", shape=[2**20] * 4), "is too large"),
        (h_is(value="speed"), "it takes 8 numbers, speed of 1 frames gives 1"),
        (h_is(value="commands", last=4), "add outputs.throttle"),
        (h_is(), "expected one of state, an output that comes back, value"),
        (h_is(stat=1), r"keys of inputs\.h: state, value, constant"),
        (h_is(constant=[1, 2]), "it takes 8 numbers, its constant gives 2"),
        ({"inputs": {"x": {"state": "h_out"}, "c": {"state": "c_out"}}}, "has no input 'x': expected image, h, c"),
        ({**RECURRENT, "input": {"frames": 2}}, "expects an input of 1x3x40x80, its description gives 1x6x40x80"),
        ({**RECURRENT, "outputs": {"steering": {"expectation": True}}}, "expectation is over bins"),
    ],
)
def test_wrong_descriptions_are_refused_in_one_line(tmp_path: Path, described: dict[str, Any], said: str) -> None:
    with pytest.raises(DriverError, match=said) as raised:
        DescribedNetworkPilot(recurrent(tmp_path, **described)[1])
    assert "\n" not in str(raised.value)


def test_bins_are_read_as_donkey_car_reads_them_or_as_their_expected_value() -> None:
    """`linear_unbin` of donkeycar 5: argmax * (R / (N + offset)) + offset, with N of 15 and 20 and R of 2 and 0.5."""
    scores = np.random.default_rng(7).random(15, np.float32)
    assert OutputSpec(bins=(-1.0, 1.0)).value(scores) == pytest.approx(np.argmax(scores) * (2.0 / (15 - 1)) - 1.0)
    throttle = np.random.default_rng(8).random(20, np.float32)
    assert OutputSpec(bins=(0.0, 0.475)).value(throttle) == pytest.approx(np.argmax(throttle) * (0.5 / 20))
    shares = scores / scores.sum()
    expected = float(np.linspace(-0.5, 1.0, 15) @ shares)
    assert OutputSpec(bins=(-0.5, 1.0), expectation=True, scale=2.0).value(shares) == pytest.approx(2.0 * expected)


CAR = Geometry(wheelbase=2.5, max_steering_angle=math.radians(40.0))


def on_arc(radius: float, *angles: float) -> np.ndarray:
    """Points on a circle to the left (radius > 0) that is tangent to the vehicle at its rear axle."""
    return np.array([(abs(radius) * math.sin(a), radius * (1.0 - math.cos(a))) for a in angles])


@pytest.mark.parametrize("radius", [4.0, -7.5, 120.0])
def test_every_point_of_an_arc_gives_its_curvature(radius: float) -> None:
    for angle in (0.1, 0.7, 1.5):
        assert pursuit_curvature(on_arc(radius, angle), math.inf) == pytest.approx(1.0 / radius)


def test_a_path_is_pursued_where_it_leaves_the_circle_of_the_lookahead() -> None:
    path = np.array([[1.0, 0.2], [2.5, 0.4], [3.0, 1.8], [1.0, 6.0]])
    ways = [path[k] + t * (path[k + 1] - path[k]) for k in range(3) for t in np.linspace(0, 1, 100_001)]
    goal = next(point for point in ways if np.hypot(*point) >= 3.3)
    assert pursuit_curvature(path, 3.3) == pytest.approx(2.0 * goal[1] / 3.3**2, abs=1e-4)
    assert pursuit_curvature(path, 50.0) == pytest.approx(2.0 * 6.0 / 37.0)
    assert pursuit_curvature(np.zeros((2, 2)), 3.0) == 0.0


def test_angles_and_curvatures_become_shares_of_a_vehicles_full_steering() -> None:
    assert OutputSpec(unit="degrees").steering(10.0, CAR) == pytest.approx(0.25)
    assert OutputSpec(unit="degrees", ratio=15.0).steering(-150.0, CAR) == pytest.approx(-0.25)
    assert OutputSpec(unit="radians").steering(math.radians(80.0), CAR) == 1.0
    turn = OutputSpec(unit="curvature").steering(-0.1, CAR)
    assert math.tan(CAR.angle_of(turn)) / CAR.wheelbase == pytest.approx(0.1)  # left positive in REP-103


@pytest.mark.parametrize("axes", [("forward", "left"), ("left", "forward"), ("forward", "right"), ("right", "forward")])
def test_a_path_is_read_along_its_axes_from_its_origin(axes: Any) -> None:
    path = on_arc(9.0, *np.linspace(0.05, 0.9, 18)) - [0.6, 0.0]
    columns = {"forward": path[:, 0], "left": path[:, 1], "right": -path[:, 1]}
    numbers = np.array([7.0, *np.column_stack([columns[one] for one in axes]).reshape(-1) / 2.0], np.float32)
    spec = PathSpec(index=1, points=18, axes=axes, scale=2.0, ahead=0.6, lookahead=5.0)
    # The path is a polygon in the circle, whose points are not on it.
    assert math.tan(CAR.angle_of(spec.steering(numbers, CAR))) / 2.5 == pytest.approx(1.0 / 9.0, rel=0.01)


class Fixed(nn.Module):
    """Answers the same numbers to every image."""

    def __init__(self, *numbers: float) -> None:
        super().__init__()
        self.numbers = nn.Parameter(torch.tensor([numbers]))

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        return self.numbers + 0.0 * image.mean()


def fixed(folder: Path, outputs: dict[str, Any], *numbers: float) -> Path:
    return written(folder, Fixed(*numbers).eval(), {"image": (1, 3, *SIZE)}, ["n"], outputs=outputs)


def test_an_angle_is_another_share_on_every_vehicle(tmp_path: Path) -> None:
    pilot = DescribedNetworkPilot(fixed(tmp_path, {"steering": {"unit": "degrees"}}, 8.0))
    shares = {}
    for name in STANDARD:
        spec = spec_of(name)
        vehicle = Geometry(spec.wheelbase, spec.max_steering_angle)
        shares[name] = pilot.predict(Frame(image=Frame.black().image, speed=0.0, vehicle=vehicle)).steering
        assert shares[name] == pytest.approx(math.radians(8.0) / spec.max_steering_angle)
    assert len(set(shares.values())) > 1
    with pytest.raises(DriverError, match="steering in degrees needs the vehicle"):
        pilot.predict(Frame(image=Frame.black().image, speed=0.0))


@pytest.mark.parametrize(
    ("outputs", "said"),
    [
        ({"path": {"points": 3, "lookahead": 4.0}}, "the output for path has 2 numbers: its description needs 6"),
        ({"path": {"points": 3}}, "lookahead is the distance"),
        ({"path": {}, "steering": {}}, "expected either steering or path"),
        ({"path": {"axes": ["left", "right"]}}, "axes are forward and either left or right"),
        ({"path": {"point": 1}}, r"keys of outputs\.path: output, index, points"),
        ({"steering": {"ratio": 15}}, "ratio is of a steering wheel's angle"),
        ({"throttle": {"unit": "degrees"}}, "throttle is a share"),
        ({"steering": {"bins": True}}, r"outputs\.steering\.bins"),
    ],
)
def test_wrong_outputs_are_refused_in_one_line(tmp_path: Path, outputs: dict[str, Any], said: str) -> None:
    with pytest.raises(DriverError, match=said) as raised:
        DescribedNetworkPilot(fixed(tmp_path, outputs, 1.0, 2.0))
    assert "\n" not in str(raised.value)


def test_a_path_that_is_not_a_number_is_an_error_of_the_drive(tmp_path: Path) -> None:
    with pytest.raises(DriverError, match="steering is nan"):
        DescribedNetworkPilot(fixed(tmp_path, {"path": {}}, math.nan, 1.0))
