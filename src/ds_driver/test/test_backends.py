# SPDX-License-Identifier: Apache-2.0
"""The backends agree, also on batches, whose errors stay with their frame; names are checked."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from made_networks import write_network
from numpy.typing import NDArray

from ds_driver.networks import backends, network_file
from ds_driver.networks.architectures import NETWORKS
from ds_driver.networks.backends import BackendError, onnx_runner
from ds_driver.networks.driver_name import DriverName
from ds_driver.networks.images import Crop, prepare
from ds_driver.networks.network_driver import NetworkDriver, on_backend
from ds_driver.networks.onnx_export import to_onnx
from ds_driver.networks.pilot import DriverError, Frame, Pilot, Prediction
from ds_driver.networks.torch_networks import module_of, replayed
from ds_driver.networks.weights import load_weights

openvino = pytest.importorskip("openvino")  # an extra for users
FRAMES = np.random.default_rng(3).integers(0, 256, (4, 160, 320, 3), dtype=np.uint8)
needs_bf16 = pytest.mark.skipif(
    "BF16" not in backends.cpu_capabilities(openvino.Core()), reason="processor without bfloat16"
)


def steering(driver: NetworkDriver, image: NDArray[np.uint8]) -> float:
    return driver.command(Frame(image=image, speed=0.0, crop=Crop(54, 1), step=1)).steering


@pytest.fixture(params=sorted(NETWORKS))
def weights(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    return write_network(tmp_path / "w.safetensors", request.param)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_replayed_kernels_give_the_bits_of_launched_ones(weights: Path) -> None:
    launched, gpu = module_of(load_weights(str(weights))).cuda(), torch.device("cuda")
    recorded = replayed(launched, gpu)
    with torch.inference_mode():
        for frame in FRAMES:
            batch = torch.from_numpy(frame[None]).permute(0, 3, 1, 2).float().to(gpu)
            assert torch.equal(recorded(batch), launched(batch))


def test_every_backend_agrees_with_pytorch(weights: Path) -> None:
    """The reference is the network itself, called directly: one batch, default memory layout, no runner."""
    network = module_of(load_weights(str(weights)))
    batch = torch.from_numpy(np.stack([prepare(f, Crop(54, 1)) for f in FRAMES])).permute(0, 3, 1, 2).float()
    expected = network(batch)[:, 0].detach().numpy()
    assert np.abs(expected).max() < 1.0 and np.ptp(expected) > 1e-4
    for backend in ("torch", "onnx", "openvino"):
        driver = NetworkDriver(f"{weights}@{backend}")
        found = [steering(driver, frame) for frame in FRAMES]
        assert found == pytest.approx(expected, abs=2e-5), backend
        assert found == [steering(driver, frame) for frame in FRAMES], backend


@needs_bf16
@pytest.mark.parametrize("network", ["dave2", "chauffeur"])
def test_bfloat16_steers_like_single_precision_to_its_eight_bits(network: str) -> None:
    single, half = (NetworkDriver(f"{network}@{backend}") for backend in ("openvino", "openvino-bf16"))
    images = [cv2.GaussianBlur(frame, (0, 0), 8) for frame in FRAMES]
    expected = [steering(single, image) for image in images]
    found = [steering(half, image) for image in images]
    assert found == pytest.approx(expected, abs=0.05) and found != expected


def test_a_processor_without_bfloat16_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """OpenVINO would compute in single precision without a word, and the name would promise something else."""
    monkeypatch.setattr(backends, "cpu_capabilities", lambda _: ["FP32", "INT8", "BIN"])
    with pytest.raises(BackendError, match=r"no bfloat16 \(AVX512_BF16 or AMX\): use the backend openvino$"):
        NetworkDriver("dave2@openvino-bf16")
    NetworkDriver("dave2@openvino")


@pytest.mark.parametrize(
    ("backend", "device", "named"),
    [
        ("openvino-bf16", "cpu", "dave2@openvino-bf16"),
        ("auto", "cpu", "dave2"),
        ("onnx", "cpu", "dave2@onnx"),
        ("torch", "cuda", "dave2@cuda"),
    ],
)
def test_a_name_carries_backend_and_device(backend: str, device: str, named: str) -> None:
    name = DriverName.parse("dave2").on(backend, device)
    assert str(name) == named and DriverName.parse(named) == name
    assert (name.network, name.backend, name.device) == ("dave2", backend, device)
    assert str(DriverName.parse("dave2@openvino").on("onnx")) == "dave2@onnx"
    assert DriverName.parse("/a@b/w.safetensors") == DriverName("/a@b/w.safetensors")


@pytest.mark.parametrize(
    ("backend", "device", "said"),
    [
        ("tensorrt", "cpu", "expected one of auto, torch, onnx, openvino, openvino-bf16"),
        ("auto", "tpu", "expected one of cpu, cuda"),
        ("onnx", "cuda", "leave out --device cuda"),
    ],
)
def test_unknown_backends_and_devices_are_refused(backend: str, device: str, said: str) -> None:
    with pytest.raises(BackendError, match=said):
        DriverName.parse("dave2").on(backend, device)


def test_a_missing_gpu_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(BackendError, match="PyTorch finds no usable GPU: leave out --device cuda"):
        NetworkDriver("dave2@cuda")


@pytest.mark.parametrize("backend", ["openvino", "openvino-bf16"])
def test_missing_openvino_is_refused_with_the_command_that_installs_it(
    backend: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "openvino", None)
    with pytest.raises(BackendError, match=r"OpenVINO is not installed.*type make setup$"):
        NetworkDriver(f"dave2@{backend}")


@pytest.mark.parametrize("wrong", ["refuses", "answers otherwise"])
def test_onnx_runtime_computes_what_openvino_does_not_compute_alike(
    wrong: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert on_backend(DriverName("residual")).backend == "openvino"
    real = backends.openvino_runner

    def faulty(content: bytes, where: str, *rest: object, kind: str) -> backends.Runner:
        if wrong == "refuses":
            raise BackendError("an operator is missing")
        runner = real(content, where, kind=kind)
        return replace(runner, compute=lambda *inputs: [1.0 + one for one in runner.compute(*inputs)])

    monkeypatch.setattr(network_file, "openvino_runner", faulty)
    assert on_backend(DriverName("residual")).backend == "onnx"


def test_a_damaged_onnx_file_is_refused() -> None:
    with pytest.raises(
        BackendError, match=r"cut\.onnx cannot be loaded by ONNX Runtime .*export it again, with its weights inside"
    ):
        onnx_runner(to_onnx(load_weights("dave2"))[:1000], "cut.onnx")


CROPS = (Crop(54, 1), Crop(0, 0), Crop(60, 24))


def frames(count: int, seed: int = 5) -> list[Frame]:
    images = np.random.default_rng(seed).integers(0, 256, (count, 160, 320, 3), dtype=np.uint8)
    return [Frame(image=image, speed=0.7 * i, crop=CROPS[i % 3], step=i % 3) for i, image in enumerate(images)]


@pytest.mark.parametrize("backend", ["openvino", pytest.param("openvino-bf16", marks=needs_bf16)])
def test_every_batch_size_gives_the_bits_of_single_frames(weights: Path, backend: str) -> None:
    driver = NetworkDriver(f"{weights}@{backend}")
    assert driver.largest_batch == 8 and driver.rows_seen(Crop(5, 3), 160, "bullet") == (5, 157)
    given = frames(9)
    expected = [driver.command(frame) for frame in given]
    assert len({one.steering for one in expected}) == len(given) and max(abs(one.steering) for one in expected) < 1
    for size in range(len(given) + 1):
        assert driver.commands(given[:size]) == expected[:size]
    # The graphs for several images are in use: their bits passed the comparison.
    batches = driver._pilot._compute.__self__  # type: ignore[attr-defined]
    assert sorted(batches._requests) == [1, 2, 4, 8]


@pytest.mark.parametrize("driver", ["dave2@onnx", "dave2@torch"])
def test_backends_whose_bits_depend_on_the_batch_take_one_frame_at_a_time(driver: str) -> None:
    network, given = NetworkDriver(driver), frames(3)
    assert network.largest_batch == 1
    assert network.commands(given) == [network.command(frame) for frame in given]


def test_batches_are_given_up_where_their_bits_differ(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stands for a processor on which the runtime selects other kernels for other batch sizes."""
    sizes: list[int] = []
    infer = backends._infer

    def other_bits(request: object, batch: np.ndarray) -> list[np.ndarray]:
        sizes.append(len(batch))
        return [output + (1e-7 if len(batch) > 1 else 0) for output in infer(request, batch)]

    driver = NetworkDriver("chauffeur@openvino")
    given = frames(6)
    expected = [driver.command(frame) for frame in given]
    monkeypatch.setattr(backends, "_infer", other_bits)
    for _ in range(2):
        sizes.clear()
        assert driver.commands(given) == expected
    assert sizes == [1] * len(given)


def test_an_error_stays_with_its_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    driver, given = NetworkDriver("chauffeur@openvino"), frames(5)
    expected = [driver.command(frame) for frame in given]
    compute = driver._pilot._compute  # type: ignore[attr-defined]

    def with_nan(batch: np.ndarray) -> list[np.ndarray]:
        steering = compute(batch)[0].copy()
        steering[2] = np.nan
        return [steering]

    monkeypatch.setattr(driver._pilot, "_compute", with_nan)
    found = driver.commands(given)
    assert isinstance(found[2], DriverError) and "steering is nan" in str(found[2])
    assert [*found[:2], *found[3:]] == [*expected[:2], *expected[3:]]


def test_a_class_with_state_sees_its_frames_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "counting_driver.py").write_text(
        "class Counting:\n"
        "    def start(self):\n"
        "        self.count = 0\n"
        "    def drive(self, frame):\n"
        "        self.count += 1\n"
        "        return float('nan') if frame.speed > 100 else self.count / 100\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    driver = NetworkDriver("counting_driver:Counting")
    assert driver.largest_batch == 1 and driver.rows_seen(Crop(5, 3), 160, "bullet") is None
    image = np.zeros((160, 320, 3), np.uint8)
    steps = [(0, 1.0), (1, 1.0), (2, 101.0), (3, 1.0), (0, 1.0), (1, 1.0)]
    found = driver.commands([Frame(image=image, speed=speed, step=step) for step, speed in steps])
    assert [None if isinstance(c, DriverError) else c.steering for c in found] == [0.01, 0.02, None, 0.04, 0.01, 0.02]


@pytest.mark.parametrize(("crop", "only"), [("simulator", True), ("none", False), ("{top: 40}", False)])
def test_a_described_network_says_whether_it_keeps_to_the_crop(crop: str, only: bool, tmp_path: Path) -> None:
    (tmp_path / "n.onnx").write_bytes(to_onnx(load_weights("dave2")))
    (tmp_path / "n.yaml").write_text(
        f"file: n.onnx\ninput: {{size: [160, 320], colour: yuv, layout: nhwc, type: uint8, crop: {crop}}}\n"
    )
    driver = NetworkDriver(str(tmp_path / "n.yaml"))
    assert (driver.rows_seen(Crop(5, 3), 160, "bullet") == (5, 157)) is only and driver.largest_batch == 1
    first, second = frames(1)[0], frames(1, seed=6)[0]
    mixed = second.image.copy()
    mixed[54:159] = first.image[54:159]
    one, other = (driver.command(Frame(image=image, speed=0.0, crop=Crop(54, 1))) for image in (first.image, mixed))
    assert (one == other) is only


def test_rows_outside_the_crop_never_matter() -> None:
    driver, given = NetworkDriver("dave2@openvino"), frames(6)
    changed = []
    for frame, other in zip(given, frames(6, seed=7), strict=True):
        rows = slice(frame.crop.top, 160 - frame.crop.bottom)
        other.image[rows] = frame.image[rows]
        changed.append(replace(frame, image=other.image))
    assert driver.commands(changed) == driver.commands(given)
    assert driver.commands(given[:1]) != driver.commands(given[1:2])


def test_a_pilot_without_batches_predicts_one_by_one() -> None:
    class Echo(Pilot):
        def start(self) -> None: ...

        def predict(self, frame: Frame) -> Prediction:
            return Prediction(float("inf") if frame.speed > 1 else frame.speed)

    found = Echo().predict_batch(frames(4))
    assert [None if isinstance(p, DriverError) else p.steering for p in found] == [0.0, 0.7, None, None]
