# SPDX-License-Identifier: Apache-2.0
"""`ds check` against planted faults, whose lines repair them, and Donkey Car's own pilots by their descriptions."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnx
import pytest
import yaml
from made_networks import write_graph
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from ds_base.progress import SILENT
from ds_driver.networks.described_network import DescribedNetworkPilot
from ds_driver.networks.driver_name import DriverName
from ds_driver.networks.pilot import DriverError, Frame, Pilot, Prediction
from ds_sim import DONKEY, SOFTBODY
from ds_studies.network_check import recording
from ds_studies.network_check.agreement import agreement
from ds_studies.network_check.description import describe_network, forms_of
from ds_studies.network_check.diagnosis import NetworkCheck, ask_open_loop, check_network
from ds_studies.network_check.recording import FEWEST, AutopilotDrives, TooSlowError, affordable, record

ROWS, COLUMNS = 20, 80
INPUT = {"size": [ROWS, COLUMNS], "crop": {"top": 60, "bottom": 25}, "divide": 255.0}
"""What the networks of these tests really expect."""


Drives = list[AutopilotDrives]


def one_by_one(work: Callable[[Any], Any], jobs: Sequence[Any], *, abandon: bool) -> Iterator[Any]:
    return map(work, jobs)


def recorded(roads: int, **asked: Any) -> Drives:
    with pytest.MonkeyPatch.context() as patch:
        patches = {"ROADS": roads, "LONGEST": 160, "EVERY": 4, "map_in_processes": one_by_one}
        for name, value in patches.items():
            patch.setattr(recording, name, value)
        return record([SOFTBODY, DONKEY], 1, SILENT, **asked)


@pytest.fixture(scope="module")
def drives() -> Drives:
    """Two drives on two simulators, which these networks are fitted to."""
    return recorded(1)


@pytest.fixture(scope="module")
def more_drives() -> Drives:
    """Six drives on each of two simulators."""
    return recorded(3)


def steering_of(drives: Drives) -> NDArray[np.float64]:
    return np.concatenate([one.steering for one in drives])


def fitted(drives: Drives, steering: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
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


def tensors(constants: Mapping[str, NDArray[np.float64]]) -> list[onnx.TensorProto]:
    return [numpy_helper.from_array(value.astype(np.float32), name) for name, value in constants.items()]


Made = Callable[..., Path]


@pytest.fixture
def made(tmp_path: Path, drives: Drives) -> Made:
    """Write a network that is right but for what is asked for; return its description."""

    def make(
        *,
        times: float = 1.0,
        plus: float = 0.0,
        bgr: bool = False,
        bins: int = 0,
        throttle: float | None = None,
        steering: NDArray[np.float64] | None = None,
        of: Drives = drives,
        **described: Any,
    ) -> Path:
        wanted = steering_of(drives)
        weights, bias = fitted(of, wanted if steering is None else steering)
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
        outputs, parts = {"angle": [1, bins or 1]}, {}
        if throttle is not None:
            constants |= {"zero": np.zeros((1, 1)), "power": np.array([[throttle]])}
            nodes += [helper.make_node("Mul", ["angle", "zero"], ["z"]), helper.make_node("Add", ["z", "power"], ["t"])]
            outputs["t"], parts = [1, 1], {"steering": {"output": "angle"}, "throttle": {"output": "t"}}
        write_graph(tmp_path / "n.onnx", nodes, {"image": [1, 3, ROWS, COLUMNS]}, outputs, tensors(constants))
        path = tmp_path / "n.yaml"
        path.write_text(yaml.safe_dump({"file": "n.onnx", "input": {**INPUT, **described}, "outputs": parts}))
        return path

    return make


def check(description: Path, drives: Drives) -> NetworkCheck:
    return check_network(DriverName(str(description)), drives, 1)


def kinds(path: Path, drives: Drives) -> list[str]:
    return [finding.kind for finding in check(path, drives).findings]


def test_a_rightly_described_network_passes(made: Made, drives: Drives) -> None:
    found = check(made(), drives)
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
    made: Made, drives: Drives, more_drives: Drives, fault: dict[str, Any], expected: list[str]
) -> None:
    if "bgr" in fault:
        assert "colour" not in kinds(made(**fault), drives)  # four drives cannot decide it
        drives = more_drives
        fault = {**fault, "of": drives, "steering": steering_of(drives)}
    path = made(**fault)
    found = check(path, drives)
    assert [finding.kind for finding in found.findings] == expected
    described = yaml.safe_load(path.read_text())
    for finding in found.findings:  # as a user would: the line's keys replace those of the file
        for part, keys in yaml.safe_load(finding.line).items():
            described[part].update(keys)
        assert "\n" not in str(finding)
    path.write_text(yaml.safe_dump(described))
    assert kinds(path, drives) == []


def test_a_constant_and_a_bad_network_are_called_that(made: Made, drives: Drives) -> None:
    assert kinds(made(times=0.0, plus=0.1), drives) == ["constant"]
    count = sum(len(one.frames) for one in drives)
    found = check(made(steering=np.random.default_rng(3).normal(0.0, 0.3, count)), drives)
    (finding,) = found.findings
    assert finding.kind == "unrelated" and finding.line == "" and "not with the road: correlation" in finding.text


@pytest.mark.parametrize(("share", "expected"), [(0.55, ["unrelated"]), (0.95, [])])
def test_a_network_that_answers_weakly_has_not_passed(
    made: Made, drives: Drives, share: float, expected: list[str]
) -> None:
    """It follows the autopilot by a share of its own steering, and noise by the rest: that is its correlation."""
    wanted = steering_of(drives)
    noise = np.random.default_rng(5).normal(0.0, 1.0, len(wanted))
    noise -= np.polyval(np.polyfit(wanted, noise, 1), wanted)
    mixed = wanted + noise * wanted.std() / noise.std() * np.sqrt(1.0 / share**2 - 1.0)
    found = check(made(steering=mixed), drives)
    assert [one.kind for one in found.findings] == expected and found.correlation == pytest.approx(share, abs=0.06)
    weak = "is not connected, or was trained on another world: correlation 0.5"
    assert (weak if expected else "is connected correctly: correlation 0.9") in found.verdict
    assert found.document()["connected_rightly"] is (not expected)


def test_writes_a_description_that_passes(made: Made, drives: Drives) -> None:
    path = made(bgr=True, times=-25.0)
    with pytest.raises(DriverError, match=r"n\.yaml describes n\.onnx already"):
        forms_of(path.with_suffix(".onnx"))
    path.unlink()
    file = path.with_suffix(".onnx")
    forms = forms_of(file)
    for form in forms:
        assert (form.input.size, form.input.layout, form.input.type) == ((ROWS, COLUMNS), "nchw", "float32")
    path.write_text(describe_network(file, forms, drives, None))
    written = yaml.safe_load(path.read_text())
    assert written["input"]["size"] == [ROWS, COLUMNS] and written["input"]["layout"] == "nchw"
    assert written["input"]["colour"] == "bgr" and written["input"]["crop"] == INPUT["crop"]
    assert written["input"]["divide"] == 255
    assert written["outputs"]["steering"]["scale"] == pytest.approx(-0.04, rel=0.1)
    assert "# chosen: correlation" in path.read_text()
    assert kinds(path, drives) == []


def test_asks_about_what_the_drives_do_not_decide(made: Made, drives: Drives) -> None:
    """The scale of a linear network's pixels is that of its answer, so both of these descriptions are right."""
    path = made()
    path.unlink()
    asked: list[str] = []

    def answer(question: str, choices: list[str], best: str) -> str:
        asked.append(question)
        assert best in choices
        return next((one for one in choices if "255" not in one and "divide" in one), best)

    path.write_text(describe_network(path.with_suffix(".onnx"), forms_of(path.with_suffix(".onnx")), drives, answer))
    questions = "\n".join(asked)
    assert "Scale of the pixels" in questions and "Part of the image" not in questions
    written = yaml.safe_load(path.read_text())
    assert written["input"]["divide"] != 255 and "# as you answered" in path.read_text()
    assert kinds(path, drives) == []


def test_describes_a_network_with_a_state_and_a_constant_by_whole_drives(
    made: Made, drives: Drives, tmp_path: Path
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
    file.with_suffix(".yaml").write_text(describe_network(file, [form], drives, None))
    written = yaml.safe_load(file.with_suffix(".yaml").read_text())
    assert written["inputs"] == {"h": {"state": "h_out"}, "route": {"constant": 0.0}}
    assert written["input"]["colour"] == "bgr" and written["input"]["crop"] == INPUT["crop"]
    assert written["outputs"]["steering"]["scale"] == pytest.approx(-0.04, rel=0.1)
    assert kinds(file.with_suffix(".yaml"), drives) == []


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
    for name, value in (("ROADS", 1), ("LONGEST", 60), ("WHOLE", slice(20, 50)), ("map_in_processes", one_by_one)):
        monkeypatch.setattr(recording, name, value)
    found = record([SOFTBODY], 1, SILENT, whole=True)
    steering, _, _ = ask_open_loop(Counting(), found)
    assert len(steering[SOFTBODY]) == 2 * 30 and [one.step for one in found[0].frames[28:32]] == [48, 49, 20, 21]


def donkey_pilot(folder: Path, weights: NDArray[np.float64], bias: float = 0.0) -> Path:
    """Write a linear network of images (1, rows, columns, 3) with Donkey Car's names of input and output."""
    constants = {"w": weights.transpose(1, 2, 0).reshape(-1, 1), "b": np.array([[bias]])}
    nodes = [
        helper.make_node("Flatten", ["img_in"], ["flat"]),
        helper.make_node("Gemm", ["flat", "w", "b"], ["n_outputs0"]),
    ]
    inputs = {"img_in": [1, *weights.shape[1:], 3]}
    return write_graph(folder / "p.onnx", nodes, inputs, {"n_outputs0": [1, 1]}, tensors(constants))


def test_what_evidence_does_not_decide_is_as_the_maker_has_it(tmp_path: Path, drives: Drives) -> None:
    """A pilot that has never seen these roads, whose best description is due to chance."""
    random = np.random.default_rng(1).normal(0.0, 0.01, (3, ROWS, COLUMNS))
    file = donkey_pilot(tmp_path, random)
    file.with_suffix(".yaml").write_text(describe_network(file, forms_of(file), drives, None))
    written = yaml.safe_load(file.with_suffix(".yaml").read_text())["input"]
    assert (written["colour"], written["crop"], written["subtract"], written["divide"]) == ("rgb", "none", 0, 255)
    assert "undecided, so as in Donkey Car" in file.with_suffix(".yaml").read_text()
    found = check(file.with_suffix(".yaml"), drives)
    assert [one.kind for one in found.findings] == ["unrelated"]
    assert "is not connected, or was trained on another world" in found.verdict


def test_clear_evidence_goes_before_the_maker(tmp_path: Path, more_drives: Drives) -> None:
    weights, bias = fitted(more_drives, steering_of(more_drives))
    file = donkey_pilot(tmp_path, weights[::-1], bias)
    written = yaml.safe_load(describe_network(file, forms_of(file), more_drives, None))["input"]
    assert (written["colour"], written["crop"]) == ("bgr", INPUT["crop"])


def test_an_image_without_its_top_rows_is_cropped_as_in_donkey_car(tmp_path: Path) -> None:
    file = donkey_pilot(tmp_path, np.zeros((3, 75, 160)))
    (form,) = forms_of(file)  # ROI_CROP_TOP = 45 of 120 rows, which are 60 of 160
    assert form.input.model_dump()["crop"] == {"top": 60, "bottom": 0}


@pytest.mark.parametrize(
    ("there", "said", "lane"),
    [(0.0, "it wants the left lane", "left"), (0.25, "it wants the middle of the road", "middle")],
)
def test_an_offset_that_another_lane_takes_away_is_a_lane(
    made: Made, drives: Drives, there: float, said: str, lane: str
) -> None:
    """A network that steers to the left by 0.25 in the right lane; in the left one not at all, or to the right."""
    left = recorded(1, lane="left")
    assert [one.steering.tolist() for one in left] != [one.steering.tolist() for one in drives]
    path = made(of=[*drives, *left], steering=np.append(steering_of(drives) - 0.25, steering_of(left) + there))
    (finding,) = check(path, drives).findings
    assert finding.kind == "lane" and said in finding.text and f"--lane {lane}" in finding.text and not finding.line


def test_a_slow_network_gets_fewer_images_or_a_line(drives: Drives) -> None:
    every = sum(len(one.frames) for one in drives)
    assert affordable(drives, 1e-6, 60.0, asked=10) == (drives, True)
    kept, search = affordable(drives, 0.5, 30.0, asked=10)
    assert not search and FEWEST <= sum(len(one.frames) for one in kept) <= 60 < every
    for few, whole in zip(kept, drives, strict=True):
        assert np.ptp(few.steering) > 0.5 * np.ptp(whole.steering)
    said = r"takes 8\.0 s for an image, and a verdict needs 24 of them: give --time 384"
    with pytest.raises(TooSlowError, match=said):
        affordable(drives, 8.0, 100.0, asked=10)


def test_drives_decide_by_their_number(more_drives: Drives) -> None:
    """Fisher's z of a difference that every drive shows, and of one that a single drive makes."""
    wanted = steering_of(more_drives)
    rng = np.random.default_rng(2)
    good, bad = (wanted + size * wanted.std() * rng.normal(size=len(wanted)) for size in (0.2, 2.0))
    assert agreement(good, more_drives).surely_above(agreement(bad, more_drives))
    assert not agreement(bad, more_drives).surely_above(agreement(good, more_drives))
    one_drive = np.where(np.arange(len(wanted)) < len(more_drives[0].steering) // 6, good, bad)
    assert not agreement(one_drive, more_drives).surely_above(agreement(bad, more_drives))


FILES = Path(__file__).parent / "data/donkeycar_pilots.zip"
"""Made by `benchmarks/donkeycar_pilots.py`, with the answers of Donkey Car's interpreter to the same frames."""
KINDS = ["linear", "categorical", "inferred", "memory", "behavior", "imu", "localizer", "rnn", "3d"]
WITHOUT_THROTTLE = {
    "inferred": "Donkey Car computes it from the angle, and here the paper's equation 2 does",
    "rnn": "second number of its only output, which has no name",
    "3d": "second number of its only output, which has no name",
}


@pytest.mark.parametrize("kind", KINDS)
def test_it_answers_as_in_donkey_car(kind: str, tmp_path: Path) -> None:
    file = tmp_path / f"{kind}.onnx"
    with zipfile.ZipFile(FILES) as packed:
        packed.extract(file.name, tmp_path)
        blocks, answers = (np.load(io.BytesIO(packed.read(name))) for name in ("frames.npy", f"{kind}.npy"))
    images = np.kron(blocks, np.ones((32, 32, 1), np.uint8))
    (described,) = forms_of(file)
    assert described.has_memory == (kind in ("memory", "rnn", "3d"))
    pilot = DescribedNetworkPilot(file, described=described)
    for _ in range(2):  # a second run begins afresh
        pilot.start()
        found = [pilot.predict(Frame(image=image, speed=0.0, step=k)) for k, image in enumerate(images)]
        assert [one.steering for one in found] == pytest.approx(answers[:, 0], abs=2e-6)
        if kind not in WITHOUT_THROTTLE:
            assert [one.throttle for one in found] == pytest.approx(answers[:, 1], abs=2e-6)
    assert len(set(answers[:, 0])) > 1 or kind == "behavior"
