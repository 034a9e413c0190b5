# SPDX-License-Identifier: Apache-2.0
"""Built-in networks: sizes, preprocessing, weights that are refused, and backends that agree, also on batches."""

from __future__ import annotations

import hashlib
import json
import math
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
import torch
from made_networks import write_network
from numpy.typing import NDArray
from safetensors.torch import save_file

from ds_driver.networks import backends, network_file
from ds_driver.networks.architectures import NETWORKS, UnknownNetworkError
from ds_driver.networks.backends import BackendError, onnx_runner
from ds_driver.networks.driver_name import DriverName
from ds_driver.networks.images import Crop, ImageError, prepare
from ds_driver.networks.network_driver import NetworkDriver, on_backend
from ds_driver.networks.onnx_export import to_onnx
from ds_driver.networks.pilot import DriverError, Frame, Pilot, Prediction
from ds_driver.networks.torch_networks import (
    FastDropout,
    disable_dropout,
    make_network,
    module_of,
    replayed,
    save_weights,
)
from ds_driver.networks.weights import Weights, WeightsError, generators_in, load_weights, shipped_networks
from ds_sim.registry import STANDARD
from ship_network import compress


@pytest.mark.parametrize(("name", "parameters"), [("dave2", 2_882_619), ("chauffeur", 104_905), ("epoch", 26_239_009)])
def test_the_networks_have_the_papers_parameters(name: str, parameters: int) -> None:
    assert NETWORKS[name].parameters == parameters
    assert sum(p.numel() for p in make_network(name).parameters()) == parameters


def test_chauffeurs_features_have_the_same_scale_in_driving_and_training() -> None:
    torch.manual_seed(1)
    network = make_network("chauffeur")
    coarse = torch.rand(4, 3, 10, 20) * 2.0 - 1.0
    images = torch.nn.functional.interpolate(coarse, size=(160, 320), mode="bilinear")
    features = network.get_submodule("features")
    with torch.inference_mode():
        trained = torch.stack([features.train()(images) for _ in range(8)]).mean(dim=0)
        driving = features.eval()(images)
    assert (trained * driving).sum() / (driving * driving).sum() == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("name", sorted(NETWORKS))
def test_weights_survive_the_round_trip(tmp_path: Path, name: str) -> None:
    torch.manual_seed(1)
    network = make_network(name).eval()
    save_weights(network, tmp_path / "a.safetensors", architecture=name)
    image = torch.rand(1, 3, 160, 320) * 255
    read = module_of(load_weights(str(tmp_path / "a.safetensors")))
    assert read(image).item() == pytest.approx(network(image).item(), abs=1e-3)
    assert not list(tmp_path.glob("*.partial"))


def test_eight_bits_halve_the_file_and_keep_the_steering(tmp_path: Path) -> None:
    whole, small = tmp_path / "whole.safetensors", tmp_path / "small.safetensors"
    torch.manual_seed(1)
    save_weights(make_network("epoch"), whole, architecture="epoch", generators={"bullet": "0" * 64})
    layers = compress(whole, small)

    assert small.stat().st_size < 0.52 * whole.stat().st_size
    assert generators_in(str(small)) == {"bullet": "0" * 64}
    before, after = (load_weights(str(path)).tensors for path in (whole, small))
    assert set(after) == set(before)
    for key, value in before.items():
        # Rounding moves a weight by half a step of its row at most.
        step = np.abs(value).max(axis=1, keepdims=True) / 127 if key in layers else np.zeros(1)
        assert (np.abs(after[key] - value) <= 0.5001 * step).all()
    images = torch.rand(8, 3, 160, 320) * 255
    expected, found = (module_of(load_weights(str(path)))(images) for path in (whole, small))
    assert torch.allclose(found, expected, atol=2e-3)


@pytest.mark.parametrize("missing", ["scale", "matrix"])
def test_integers_without_scales_for_their_rows_are_refused(tmp_path: Path, missing: str) -> None:
    tensors = {key: torch.zeros(shape) for key, shape in NETWORKS["chauffeur"].shapes().items()}
    key = next(key for key, value in tensors.items() if (value.ndim == 2) == (missing == "scale"))
    tensors[key] = tensors[key].to(torch.int8)
    if missing == "matrix":
        tensors[key + ".scale"] = torch.ones(tensors[key].shape[0])
    save_file(tensors, tmp_path / "a.safetensors", metadata={"architecture": "chauffeur"})
    with pytest.raises(WeightsError, match="do not fit chauffeur"):
        load_weights(str(tmp_path / "a.safetensors"))


EXPORTS = {
    "dave2": "66f64067fecaa096cba26c012bbe13528c48c8b62ce5223a406a975dd76d1d56",
    "chauffeur": "117453f4065eb9e609c8f80418b92988a591962e7696cbb55235fc20b813b9de",
    "epoch": "66ce1e4a535530b1818951ff83e9e2beb7508447a5fb13064dd8f6bb4f3cdb8f",
}
"""SHA-256 of the ONNX files of `drawn_weights`, with onnx as pinned, by an export whose graphs steer as those of
version 0.2.0, to the bit."""


def drawn_weights(name: str) -> Weights:
    rng = np.random.default_rng(1)
    shapes = NETWORKS[name].shapes()
    return Weights(name, NETWORKS[name], {key: rng.random(shape, np.float32) for key, shape in shapes.items()})


@pytest.mark.parametrize("name", sorted(NETWORKS))
def test_the_exported_graphs_keep_their_bytes(name: str) -> None:
    content = to_onnx(drawn_weights(name))
    onnx.checker.check_model(content)
    assert hashlib.sha256(content).hexdigest() == EXPORTS[name]


@pytest.mark.parametrize("kind", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_every_number_type_is_read_as_pytorch_reads_it(tmp_path: Path, kind: torch.dtype) -> None:
    torch.manual_seed(4)
    tensors = {name: value.to(kind) for name, value in make_network("chauffeur").state_dict().items()}
    tensors["steering.2.bias"].fill_(2.0**-20)  # subnormal in float16
    path = tmp_path / "w.safetensors"
    save_file(tensors, path, metadata={"architecture": "chauffeur"})
    found = load_weights(str(path)).tensors
    assert set(found) == set(tensors)
    for name, value in tensors.items():
        assert found[name].tobytes() == value.float().numpy().tobytes(), name


Tensors = dict[str, torch.Tensor]


def held(tensors: Tensors, path: Path, metadata: dict[str, str] | None = None) -> None:
    save_file(tensors, path, metadata={"architecture": "dave2"} if metadata is None else metadata)


UNUSABLE: dict[str, Callable[[Tensors, Path], object]] = {
    "truncated": lambda tensors, path: path.write_bytes(path.read_bytes()[:100_000]),
    "pickle": lambda tensors, path: torch.save(tensors, path),
    "empty": lambda tensors, path: path.write_bytes(b""),
    "other": lambda tensors, path: held({"a": torch.zeros(2)}, path),
    "foreign": lambda tensors, path: held({"a": torch.zeros(2)}, path, {}),
    "nan": lambda tensors, path: held({**tensors, "steering.1.bias": tensors["steering.1.bias"] * math.nan}, path),
    "beyond float32": lambda tensors, path: held(
        {name: value.double() + (1e300 if name == "steering.1.bias" else 0.0) for name, value in tensors.items()}, path
    ),
    "integers": lambda tensors, path: held({name: value.to(torch.int8) for name, value in tensors.items()}, path),
    "missing": lambda tensors, path: path.unlink(),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("damage", UNUSABLE.values(), ids=UNUSABLE.keys())
def test_unusable_weights_are_refused_in_one_line(tmp_path: Path, damage: Callable[[Tensors, Path], object]) -> None:
    path, network = tmp_path / "w.safetensors", make_network("dave2")
    save_weights(network, path, architecture="dave2")
    damage(network.state_dict(), path)
    with pytest.raises(WeightsError) as refused:
        NetworkDriver(str(path))
    assert "\n" not in str(refused.value) and ":" in str(refused.value)


@pytest.mark.parametrize("name", ["dave3", "weights.h5", ""])
def test_an_unknown_network_is_refused(name: str) -> None:
    with pytest.raises(UnknownNetworkError, match="expected one of dave2"):
        load_weights(name)


def test_preprocessing_crops_resizes_and_converts_to_yuv() -> None:
    image = np.zeros((160, 320, 3), np.uint8)
    image[80:] = (10, 200, 30)
    whole, part = prepare(image, Crop()), prepare(image, Crop(80, 0))
    assert whole.shape == part.shape == (160, 320, 3)
    # BT.601 by hand: Y = 0.299 R + 0.587 G + 0.114 B
    assert part[..., 0] == pytest.approx(0.299 * 10 + 0.587 * 200 + 0.114 * 30, abs=1)
    assert whole[0, 0, 0] == 0 and whole[-1, 0, 0] == part[0, 0, 0]


@pytest.mark.parametrize("shape", [(120, 160, 3), (160, 320), (160, 320, 4), (0, 0, 3)])
def test_an_image_of_another_size_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ImageError, match="expected"):
        prepare(np.zeros(shape, np.uint8), Crop())


@pytest.mark.parametrize("rows", [(160, 0), (-1, 0), (100, 60)])
def test_a_crop_that_leaves_nothing_is_refused(rows: tuple[int, int]) -> None:
    with pytest.raises(ImageError, match="expected at most"):
        Crop(*rows)


def test_shipped_networks_have_a_card_and_drive_within_range() -> None:
    shipped = shipped_networks()
    assert "dave2" in shipped
    for name, path in shipped.items():
        card = json.loads(path.with_suffix(".json").read_text())
        assert set(card) >= {"network", "parameters", "data", "seeds", "commands", "loss", "success", "roads"}
        if path.suffix == ".safetensors":
            assert card["parameters"] == load_weights(name).architecture.parameters
        assert set(card["success"]) == set(STANDARD)
        rates = [rate for ways in card["success"].values() for rate in ways.values()]
        assert name.endswith("_short") or min(rates) >= 0.5  # those are trained briefly on purpose
        driver = NetworkDriver(name)
        image = np.random.default_rng(1).integers(0, 256, (160, 320, 3), dtype=np.uint8)
        frame = Frame(image=image, speed=5.0, crop=Crop(60, 0), step=0, simulator="bullet")
        command = driver.command(frame)
        assert driver.command(frame) == command
        assert bool(card.get("sim2real")) == (driver.command(replace(frame, simulator="donkey")) != command)
        assert -1.0 <= command.steering <= 1.0 and 0.0 <= command.throttle <= 1.0


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float32])
@pytest.mark.parametrize("rescale", [True, False])
def test_dropout_drops_its_share_and_follows_the_seed(dtype: torch.dtype, rescale: bool) -> None:
    layer = FastDropout(0.1, rescale=rescale)
    values = torch.ones((2, 16, 40, 80), dtype=dtype).to(memory_format=torch.channels_last)
    torch.manual_seed(5)
    first, second = layer(values), layer(values)
    torch.manual_seed(5)
    assert torch.equal(layer(values), first) and not torch.equal(first, second)
    assert float((first == 0).float().mean()) == pytest.approx(0.1, abs=0.01)
    assert first.unique().tolist() == pytest.approx([0.0, 1.0 / 0.9 if rescale else 1.0], rel=0.004)
    network = torch.nn.Sequential(layer)
    disable_dropout(network)
    assert torch.equal(network(values), values)
    network.train()
    assert not torch.equal(network(values), values)


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
