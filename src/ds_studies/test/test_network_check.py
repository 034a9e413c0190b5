# SPDX-License-Identifier: Apache-2.0
"""`ds check` against planted faults: what it says, and whether the line that it names repairs the description."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnx
import pytest
import yaml
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from ds_base.progress import SILENT
from ds_driver.networks.pilot import DriverError, Frame, Pilot, Prediction
from ds_studies.network_check import recording
from ds_studies.network_check.description import describe, forms_of
from ds_studies.network_check.diagnosis import NetworkCheck, ask_open_loop, check_network
from ds_studies.network_check.recording import Recording, record

ROWS, COLUMNS = 20, 80
INPUT = {"size": [ROWS, COLUMNS], "crop": {"top": 60, "bottom": 25}, "divide": 255.0}
"""What the networks of these tests really expect."""


@pytest.fixture(scope="module")
def drives() -> list[Recording]:
    """Two drives on two simulators, which these networks are fitted to."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recording, "ROADS", 1)
        patch.setattr(recording, "LONGEST", 160)
        patch.setattr(recording, "EVERY", 4)
        patch.setattr(recording, "map_in_processes", map)
        return record(["softbody", "donkey"], 1, SILENT)


def fitted(drives: list[Recording], steering: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Weights (channels, rows, columns) and bias of the linear network of least norm that steers so, without its code.

    The pixels are prepared with OpenCV alone, so that a mistake in the project's preparation is a fault, too.
    """
    images = [frame.image[60:135] for one in drives for frame in one.frames]
    small = [cv2.resize(image, (COLUMNS, ROWS)).transpose(2, 0, 1).reshape(-1) / 255.0 for image in images]
    pixels = np.array(small)
    centred = pixels - pixels.mean(axis=0)
    dual = np.linalg.solve(centred @ centred.T + 0.1 * np.eye(len(centred)), steering - steering.mean())
    weights = centred.T @ dual
    return weights.reshape(3, ROWS, COLUMNS), float(steering.mean() - pixels.mean(axis=0) @ weights)


Made = Callable[..., Path]


@pytest.fixture
def made(tmp_path: Path, drives: list[Recording]) -> Made:
    """Write a network that is right but for what is asked for; return its description."""

    def make(
        *,
        times: float = 1.0,
        plus: float = 0.0,
        bgr: bool = False,
        bins: int = 0,
        throttle: float | None = None,
        steering: NDArray[np.float64] | None = None,
        **described: Any,
    ) -> Path:
        wanted = np.concatenate([one.steering for one in drives])
        weights, bias = fitted(drives, wanted if steering is None else steering)
        weights = weights[::-1] if bgr else weights
        constants = {"w": times * weights.reshape(-1, 1), "b": np.array([[times * bias + plus]])}
        nodes = [
            helper.make_node("Flatten", ["image"], ["flat"]),
            helper.make_node("Gemm", ["flat", "w", "b"], ["number" if bins else "angle"]),
        ]
        if bins:
            constants |= {"centres": np.linspace(-1, 1, bins)[None], "sharp": np.array([[-50.0]])}
            nodes += [
                helper.make_node("Sub", ["number", "centres"], ["d"]),
                helper.make_node("Mul", ["d", "d"], ["dd"]),
                helper.make_node("Mul", ["dd", "sharp"], ["scores"]),
                helper.make_node("Softmax", ["scores"], ["angle"]),
            ]
        outputs = [helper.make_tensor_value_info("angle", TensorProto.FLOAT, [1, bins or 1])]
        if throttle is not None:
            constants |= {"zero": np.zeros((1, 1)), "power": np.array([[throttle]])}
            nodes += [helper.make_node("Mul", ["angle", "zero"], ["z"]), helper.make_node("Add", ["z", "power"], ["t"])]
            outputs.append(helper.make_tensor_value_info("t", TensorProto.FLOAT, [1, 1]))
            described["outputs"] = {"steering": {"output": "angle"}, "throttle": {"output": "t"}}
        image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, ROWS, COLUMNS])
        held = [numpy_helper.from_array(value.astype(np.float32), name) for name, value in constants.items()]
        graph = helper.make_graph(nodes, "made", [image], outputs, held)
        onnx.save(
            helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), tmp_path / "n.onnx"
        )
        path = tmp_path / "n.yaml"
        outputs_described = described.pop("outputs", {})
        path.write_text(
            yaml.safe_dump({"file": "n.onnx", "input": {**INPUT, **described}, "outputs": outputs_described})
        )
        return path

    return make


def kinds(path: Path, drives: list[Recording]) -> list[str]:
    return [finding.kind for finding in check_network(str(path), drives, 1).findings]


def test_a_rightly_described_network_passes(made: Made, drives: list[Recording]) -> None:
    found = check_network(str(made()), drives, 1)

    assert found.findings == [] and "is connected correctly" in found.verdict and found.correlation > 0.9
    assert [one.simulator for one in found.answers] == ["softbody", "donkey"]
    assert all(one.milliseconds > 0.0 and one.at_full_lock <= 0.1 for one in found.answers)


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        ({"times": 25.0}, ["degrees"]),
        ({"times": 0.4363}, ["radians"]),
        ({"times": -1.0}, ["sign"]),
        ({"times": 0.001}, ["scale"]),
        ({"plus": 0.5}, ["offset"]),
        ({"bgr": True}, ["colour"]),
        ({"crop": "none"}, ["crop"]),
        ({"divide": 1.0}, ["pixels"]),
        ({"bins": 15}, ["bins"]),
        ({"throttle": 0.005}, ["crawls"]),
        ({"bgr": True, "crop": "none", "times": -25.0}, ["colour", "crop", "degrees", "sign"]),
    ],
)
def test_names_a_planted_fault_and_the_line_that_repairs_it(
    made: Made, drives: list[Recording], fault: dict[str, Any], expected: list[str]
) -> None:
    path = made(**fault)

    found = check_network(str(path), drives, 1)

    assert [finding.kind for finding in found.findings] == expected
    described = yaml.safe_load(path.read_text())
    for finding in found.findings:  # as a user would: the line's keys replace those of the file
        for part, keys in yaml.safe_load(finding.line).items():
            described[part].update(keys)
        assert "\n" not in str(finding)
    path.write_text(yaml.safe_dump(described))
    assert kinds(path, drives) == []


def test_a_constant_and_a_bad_network_are_called_that(made: Made, drives: list[Recording]) -> None:
    assert kinds(made(times=0.0, plus=0.1), drives) == ["constant"]
    count = sum(len(one.frames) for one in drives)
    found = check_network(str(made(steering=np.random.default_rng(3).normal(0.0, 0.3, count))), drives, 1)
    (finding,) = found.findings
    assert finding.kind == "unrelated" and finding.line == "" and "not with the road: correlation" in finding.text


def test_a_weak_network_is_not_called_connected_rightly() -> None:
    weak = NetworkCheck(driver="n", images=1, correlation=0.7, answers=[], findings=[], steering={}, fixed=None)

    assert weak.verdict == "n answers with the road, but weakly: correlation 0.70 with the autopilot."
    assert weak.document()["connected_rightly"] is False


def test_writes_a_description_that_passes(made: Made, drives: list[Recording]) -> None:
    path = made(bgr=True, times=-25.0)
    with pytest.raises(DriverError, match=r"n\.yaml describes n\.onnx already"):
        forms_of(path.with_suffix(".onnx"))
    path.unlink()
    file = path.with_suffix(".onnx")

    path.write_text(describe(file, form_of_file(file), drives, None))

    written = yaml.safe_load(path.read_text())
    assert written["input"]["size"] == [ROWS, COLUMNS] and written["input"]["layout"] == "nchw"
    assert written["input"]["colour"] == "bgr" and written["input"]["crop"] == INPUT["crop"]
    assert written["input"]["divide"] == 255
    assert written["outputs"]["steering"]["scale"] == pytest.approx(-0.04, rel=0.1)
    assert "# chosen: correlation" in path.read_text()
    assert kinds(path, drives) == []


def test_asks_about_what_the_drives_do_not_decide(made: Made, drives: list[Recording]) -> None:
    """The scale of a linear network's pixels is that of its answer, so both of these descriptions are right."""
    path = made()
    path.unlink()
    asked: list[str] = []

    def answer(question: str, choices: list[str], best: str) -> str:
        asked.append(question)
        assert best in choices
        return next((one for one in choices if "255" not in one and "divide" in one), best)

    path.write_text(describe(path.with_suffix(".onnx"), forms_of(path.with_suffix(".onnx")), drives, answer))

    assert any("Scale of the pixels" in question for question in asked) and not any(
        "Part of the image" in one for one in asked
    )
    written = yaml.safe_load(path.read_text())
    assert written["input"]["divide"] != 255 and "# as you answered" in path.read_text()
    assert kinds(path, drives) == []


def test_describes_a_network_with_a_state_and_a_constant_by_whole_drives(
    made: Made, drives: list[Recording], tmp_path: Path
) -> None:
    model = onnx.load(made(bgr=True, times=-25.0).with_suffix(".onnx"))
    vector = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, 4]) for name in ("h", "h_out", "route")]
    model.graph.input.extend([vector[0], vector[2]])
    model.graph.output.append(vector[1])
    model.graph.node.append(helper.make_node("Add", ["h", "route"], ["h_out"]))
    file = tmp_path / "recurrent.onnx"
    onnx.save(model, file)
    (form,) = forms_of(file)
    assert form.has_memory
    file.with_suffix(".yaml").write_text(describe(file, [form], drives, None))
    written = yaml.safe_load(file.with_suffix(".yaml").read_text())
    assert written["inputs"] == {"h": {"state": "h_out"}, "route": {"constant": 0.0}}
    assert written["input"]["colour"] == "bgr" and written["input"]["crop"] == INPUT["crop"]
    assert written["outputs"]["steering"]["scale"] == pytest.approx(-0.04, rel=0.1)
    assert kinds(file.with_suffix(".yaml"), drives) == []


def form_of_file(file: Path) -> list[Any]:
    forms = forms_of(file)
    assert [(form.input.size, form.input.layout, form.input.type) for form in forms] == [
        ((ROWS, COLUMNS), "nchw", "float32")
    ]
    return forms


class Counting(Pilot):
    """A network with memory that is of no use unless it sees every frame, and knows when a run begins."""

    has_memory = True

    def start(self) -> None:
        self.before: int | None = None

    def predict(self, frame: Frame) -> Prediction:
        assert self.before is None or frame.step == self.before + 1
        self.before = frame.step
        return Prediction(0.0)


def test_a_network_with_memory_is_shown_whole_pieces_of_drives(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("ROADS", 1), ("LONGEST", 60), ("WHOLE", slice(20, 50)), ("map_in_processes", map)):
        monkeypatch.setattr(recording, name, value)
    found = record(["softbody"], 1, SILENT, whole=True)
    steering, _, _ = ask_open_loop(Counting(), found)
    assert len(steering["softbody"]) == 2 * 30 and [one.step for one in found[0].frames[28:32]] == [48, 49, 20, 21]
