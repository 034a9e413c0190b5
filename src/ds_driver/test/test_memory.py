# SPDX-License-Identifier: Apache-2.0
"""Networks with several inputs, stacks of frames and states, against PyTorch itself."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from torch import nn

from ds_driver.closed_loop.simulation import drive_road, make_driver
from ds_driver.networks.described_network import DescribedNetworkPilot
from ds_driver.networks.description import OutputSpec
from ds_driver.networks.pilot import DriverError, Frame
from ds_road import generate
from ds_sim.registry import make_simulator
from ds_sim.run_codec import encode_run

pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit:DeprecationWarning")

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


class Stacked(nn.Module):
    """Three images as nine channels."""

    def __init__(self) -> None:
        super().__init__()
        self.see = nn.Conv2d(9, 4, 5, stride=4)
        self.steer = nn.Linear(4 * 9 * 19, 1)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        found: torch.Tensor = self.steer(torch.relu(self.see(image)).flatten(1))
        return found


class Sequence3d(nn.Module):
    """Four images along an axis of time, channels last, as Donkey Car's `3d` and `rnn` pilots take them."""

    def __init__(self) -> None:
        super().__init__()
        self.see = nn.Conv3d(3, 4, (2, 5, 5), stride=(1, 4, 4))
        self.steer = nn.Linear(4 * 3 * 9 * 19, 1)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        found: torch.Tensor = self.steer(torch.relu(self.see(image.permute(0, 4, 1, 2, 3))).flatten(1))
        return found


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
    return kind().eval()


def written(
    folder: Path, made: nn.Module, shapes: list[tuple[int, ...]], taken: list[str], given: list[str], **described: Any
) -> Path:
    zeros = tuple(torch.zeros(shape) for shape in shapes)
    torch.onnx.export(made, zeros, str(folder / "net.onnx"), input_names=taken, output_names=given, dynamo=False)
    image = {"size": list(SIZE), "divide": 255.0, **described.pop("input", {})}
    path = folder / "net.yaml"
    path.write_text(yaml.safe_dump({"file": "net.onnx", "input": image, **described}))
    return path


def seen(frame: Frame) -> torch.Tensor:
    import cv2

    small = cv2.resize(frame.image, SIZE[::-1], interpolation=cv2.INTER_LINEAR)
    return torch.from_numpy(small.transpose(2, 0, 1)[None].astype(np.float32) / np.float32(255.0))


def answers(pilot: DescribedNetworkPilot) -> list[float]:
    pilot.start()
    return [pilot.predict(frame).steering for frame in FRAMES]


RECURRENT = {"inputs": {"h": {"state": "h_out"}, "c": {"state": "c_out", "start": 0.5}}}
SHAPES = [(1, 3, *SIZE), (1, 8), (1, 8)]


@pytest.mark.parametrize("backend", ["onnx", "openvino"])
def test_a_state_comes_back_in_the_next_frame_and_begins_afresh_with_a_run(tmp_path: Path, backend: str) -> None:
    if backend == "openvino":
        pytest.importorskip("openvino")
    made = network(Recurrent)
    path = written(tmp_path, made, SHAPES, ["image", "h", "c"], ["steering", "h_out", "c_out"], **RECURRENT)
    h, c, expected = torch.zeros(1, 8), torch.full((1, 8), 0.5), []
    with torch.inference_mode():
        for frame in FRAMES:
            steering, h, c = made(seen(frame), h, c)
            expected.append(float(steering))
    pilot = DescribedNetworkPilot(path, backend)
    first = answers(pilot)
    assert first == pytest.approx(expected, abs=1e-5) and len(set(np.round(first, 4))) > 5
    assert answers(pilot) == first


def test_a_traced_network_has_inputs_by_position(tmp_path: Path) -> None:
    made = network(Recurrent)
    torch.jit.trace(made, tuple(torch.zeros(shape) for shape in SHAPES)).save(tmp_path / "net.pt")
    written(tmp_path, made, SHAPES, ["image", "h", "c"], ["steering", "h_out", "c_out"], **RECURRENT)
    path = tmp_path / "traced.yaml"
    states = {1: {"state": 1, "shape": [1, 8]}, 2: {"state": 2, "shape": [1, 8], "start": 0.5}}
    path.write_text(
        yaml.safe_dump({"file": "net.pt", "input": {"size": list(SIZE), "divide": 255.0}, "inputs": states})
    )
    traced, named = DescribedNetworkPilot(path), DescribedNetworkPilot(tmp_path / "net.yaml")
    assert answers(traced) == pytest.approx(answers(named), abs=1e-5)


@pytest.mark.parametrize("order", ["oldest_first", "newest_first"])
def test_a_stack_holds_frames_a_stride_apart_and_begins_with_the_first(tmp_path: Path, order: str) -> None:
    made = network(Stacked)
    stack = {"frames": 3, "stride": 2, "order": order}
    path = written(tmp_path, made, [(1, 9, *SIZE)], ["image"], ["steering"], input=stack)
    expected = []
    for step in range(len(FRAMES)):
        back = [FRAMES[max(step - k, 0)] for k in (4, 2, 0)]
        pixels = torch.cat([seen(one) for one in (back if order == "oldest_first" else reversed(back))], 1)
        with torch.inference_mode():
            expected.append(float(made(pixels)))
    assert answers(DescribedNetworkPilot(path)) == pytest.approx(expected, abs=1e-5)


def test_time_is_an_axis_of_its_own(tmp_path: Path) -> None:
    made = network(Sequence3d)
    described = {"frames": 4, "stacked": "time", "layout": "nhwc"}
    path = written(tmp_path, made, [(1, 4, *SIZE, 3)], ["image"], ["steering"], input=described)
    expected = []
    for step in range(len(FRAMES)):
        back = [seen(FRAMES[max(step - k, 0)]).permute(0, 2, 3, 1) for k in (3, 2, 1, 0)]
        with torch.inference_mode():
            expected.append(float(made(torch.stack(back, 1))))
    assert answers(DescribedNetworkPilot(path)) == pytest.approx(expected, abs=1e-5)


def test_commands_and_speed_are_given(tmp_path: Path) -> None:
    made = network(Remembering)
    given = {"mem": {"value": "commands", "last": 3}, "speed": {"value": "speed", "scale": 0.1}}
    outputs = {"steering": {"output": "angle"}, "throttle": {"output": "gas"}}
    path = written(
        tmp_path,
        made,
        [(1, 3, *SIZE), (1, 6), (1, 1)],
        ["image", "mem", "speed"],
        ["angle", "gas"],
        inputs=given,
        outputs=outputs,
    )
    memory, expected = torch.zeros(1, 6), []
    with torch.inference_mode():
        for frame in FRAMES:
            angle, gas = made(seen(frame), memory, torch.full((1, 1), 0.1 * frame.speed))
            memory = torch.cat([memory[:, 2:], angle, gas], 1)
            expected.append(float(angle))
    assert answers(DescribedNetworkPilot(path)) == pytest.approx(expected, abs=1e-4)


def test_runs_of_one_process_share_no_state(tmp_path: Path) -> None:
    made = network(Recurrent)
    path = written(tmp_path, made, SHAPES, ["image", "h", "c"], ["steering", "h_out", "c_out"], **RECURRENT)
    simulator = make_simulator("softbody")
    driver, (one, other) = (
        make_driver(str(path), simulator.spec),
        (generate(np.random.default_rng(4)), generate(np.random.default_rng(5))),
    )
    first = encode_run(drive_road(simulator, driver, one, 1))
    drive_road(simulator, driver, other, 2)
    assert encode_run(drive_road(simulator, driver, one, 1)) == first
    simulator.close()


@pytest.mark.parametrize(
    ("described", "said"),
    [
        ({}, r"has 3 inputs \(image, h, c\), its description gives 1: `input` is the image"),
        ({"inputs": {"h": {"state": "h_out"}}}, "its description gives 2"),
        ({"inputs": {"h": {"state": "gone"}, "c": {"state": "c_out"}}}, "there is no output 'gone' for the state"),
        (
            {"inputs": {"h": {"state": "steering"}, "c": {"state": "c_out"}}},
            "has 1 numbers, the input that it comes back",
        ),
        ({"inputs": {"h": {"state": "h_out", "shape": [1, 9]}, "c": {"state": "c_out"}}}, "expects 1x8 as input h"),
        ({"inputs": {"h": {"state": "h_out", "shape": [2**20] * 4}, "c": {"state": "c_out"}}}, "is too large"),
        (
            {"inputs": {"h": {"value": "speed"}, "c": {"state": "c_out"}}},
            "it takes 8 numbers, speed of 1 frames gives 1",
        ),
        ({"inputs": {"h": {"value": "commands", "last": 4}, "c": {"state": "c_out"}}}, "add outputs.throttle"),
        ({"inputs": {"h": {}, "c": {"state": "c_out"}}}, "expected one of state, an output that comes back, value"),
        ({"inputs": {"h": {"stat": 1}, "c": {"state": "c_out"}}}, r"keys of inputs\.h: state, value, constant"),
        ({"inputs": {"h": {"constant": [1, 2]}, "c": {"state": "c_out"}}}, "it takes 8 numbers, its constant gives 2"),
        ({"inputs": {"x": {"state": "h_out"}, "c": {"state": "c_out"}}}, "has no input 'x': expected image, h, c"),
        ({**RECURRENT, "input": {"frames": 2}}, "expects an input of 1x3x40x80, its description gives 1x6x40x80"),
        ({**RECURRENT, "outputs": {"steering": {"expectation": True}}}, "expectation is over bins"),
    ],
)
def test_wrong_descriptions_are_refused_in_one_line(tmp_path: Path, described: dict[str, Any], said: str) -> None:
    path = written(
        tmp_path, network(Recurrent), SHAPES, ["image", "h", "c"], ["steering", "h_out", "c_out"], **described
    )
    with pytest.raises(DriverError, match=said) as raised:
        DescribedNetworkPilot(path)
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
