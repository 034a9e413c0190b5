# SPDX-License-Identifier: Apache-2.0
"""Sizes and preprocessing of the built-in networks, and weights files that are refused."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from safetensors.torch import save_file

from ds_driver.networks.architectures import NETWORKS, UnknownNetworkError
from ds_driver.networks.images import Crop, ImageError, prepare
from ds_driver.networks.network_driver import NetworkDriver
from ds_driver.networks.onnx_export import to_onnx
from ds_driver.networks.pilot import Frame
from ds_driver.networks.torch_networks import FastDropout, disable_dropout, make_network, module_of, save_weights
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
