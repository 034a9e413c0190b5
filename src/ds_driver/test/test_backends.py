# SPDX-License-Identifier: Apache-2.0
"""The backends agree, and names of backends and devices are checked."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from ds_driver.networks import backends, network_file
from ds_driver.networks.architectures import NETWORKS
from ds_driver.networks.backends import BackendError, onnx_runner
from ds_driver.networks.driver_name import DriverName
from ds_driver.networks.images import Crop, prepare
from ds_driver.networks.network_driver import NetworkDriver, on_backend
from ds_driver.networks.onnx_export import to_onnx
from ds_driver.networks.pilot import Frame
from ds_driver.networks.torch_networks import make_network, module_of, replayed, save_weights
from ds_driver.networks.weights import load_weights

openvino = pytest.importorskip("openvino")  # an extra for users
FRAMES = np.random.default_rng(3).integers(0, 256, (4, 160, 320, 3), dtype=np.uint8)
needs_bf16 = pytest.mark.skipif(
    "BF16" not in backends.cpu_capabilities(openvino.Core()), reason="processor without bfloat16"
)


def steering(driver: NetworkDriver, image: NDArray[np.uint8]) -> float:
    return driver.command(Frame(image=image, speed=0.0, crop=Crop(54, 1), step=1)).steering


@pytest.fixture(params=sorted(NETWORKS))
def weights(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[str, Path]:
    torch.manual_seed(2)
    path = tmp_path / "w.safetensors"
    network = make_network(request.param)
    with torch.no_grad():
        list(network.parameters())[-2].mul_(0.2)  # keeps the steering within its range, so nothing is clipped
    save_weights(network, path, architecture=request.param)
    return request.param, path


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_replayed_kernels_give_the_bits_of_launched_ones(weights: tuple[str, Path]) -> None:
    launched, gpu = module_of(load_weights(str(weights[1]))).cuda(), torch.device("cuda")
    recorded = replayed(launched, gpu)
    with torch.inference_mode():
        for frame in FRAMES:
            batch = torch.from_numpy(frame[None]).permute(0, 3, 1, 2).float().to(gpu)
            assert torch.equal(recorded(batch), launched(batch))


def test_every_backend_agrees_with_pytorch(weights: tuple[str, Path]) -> None:
    """The reference is the network itself, called directly: one batch, default memory layout, no runner."""
    network = module_of(load_weights(str(weights[1])))
    with torch.inference_mode():
        batch = torch.from_numpy(np.stack([prepare(f, Crop(54, 1)) for f in FRAMES])).permute(0, 3, 1, 2).float()
        expected = network(batch)[:, 0].numpy()
    assert np.abs(expected).max() < 1.0 and np.ptp(expected) > 1e-4
    for backend in ("torch", "onnx", "openvino"):
        driver = NetworkDriver(f"{weights[1]}@{backend}")
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
