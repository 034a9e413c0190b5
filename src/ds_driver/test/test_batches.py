# SPDX-License-Identifier: Apache-2.0
"""Frames in a batch get the commands that each gets alone, and an error stays with its frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from ds_driver.networks import backends
from ds_driver.networks.architectures import NETWORKS
from ds_driver.networks.images import Crop
from ds_driver.networks.network_driver import NetworkDriver
from ds_driver.networks.pilot import DriverError, Frame, Pilot, Prediction
from ds_driver.networks.torch_networks import make_network, save_weights
from ds_driver.networks.weights import load_weights

openvino = pytest.importorskip("openvino")  # an extra for users
CROPS = (Crop(54, 1), Crop(0, 0), Crop(60, 24))


def frames(count: int, seed: int = 5) -> list[Frame]:
    """Make frames with different images, crops, speeds and steps."""
    rng = np.random.default_rng(seed)
    return [
        Frame(
            image=rng.integers(0, 256, (160, 320, 3), dtype=np.uint8),
            speed=0.7 * i,
            crop=CROPS[i % len(CROPS)],
            step=i % 3,
        )
        for i in range(count)
    ]


def alone(driver: NetworkDriver, frame: Frame) -> tuple[float, float]:
    command = driver.command(frame)
    return command.steering, command.throttle


@pytest.mark.parametrize("backend", ["openvino", "openvino-bf16"])
@pytest.mark.parametrize("architecture", sorted(NETWORKS))
def test_every_batch_size_gives_the_bits_of_single_frames(architecture: str, backend: str, tmp_path: Path) -> None:
    if backend == "openvino-bf16" and "BF16" not in backends.cpu_capabilities(openvino.Core()):
        pytest.skip("processor without bfloat16")
    torch.manual_seed(2)
    path = tmp_path / "w.safetensors"
    network = make_network(architecture)
    with torch.no_grad():
        list(network.parameters())[-2].mul_(0.2)  # keeps the steering within its range, so nothing is clipped
    save_weights(network, path, architecture=architecture)
    driver = NetworkDriver(f"{path}@{backend}")
    assert driver.largest_batch == 8 and driver.rows_seen(Crop(5, 3), 160) == (5, 157)
    given = frames(9)
    expected = [alone(driver, frame) for frame in given]
    assert len({steering for steering, _ in expected}) == len(given) and max(abs(s) for s, _ in expected) < 1
    for size in range(len(given) + 1):
        found = driver.commands(given[:size])
        assert [(c.steering, c.throttle) for c in found if not isinstance(c, DriverError)] == expected[:size]
    # The graphs for several images are in use: their bits passed the comparison.
    batches = driver._pilot._compute.__self__  # type: ignore[attr-defined]
    assert sorted(batches._requests) == [1, 2, 4, 8]


@pytest.mark.parametrize("driver", ["dave2@onnx", "dave2@torch"])
def test_backends_whose_bits_depend_on_the_batch_take_one_frame_at_a_time(driver: str) -> None:
    network = NetworkDriver(driver)
    given = frames(3)
    expected = [alone(network, frame) for frame in given]
    found = network.commands(given)
    assert network.largest_batch == 1
    assert [(c.steering, c.throttle) for c in found if not isinstance(c, DriverError)] == expected


def test_batches_are_given_up_where_their_bits_differ(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stands for a processor on which the runtime selects other kernels for other batch sizes."""
    sizes: list[int] = []
    infer = backends._infer

    def other_bits(request: object, batch: np.ndarray) -> list[np.ndarray]:
        sizes.append(len(batch))
        return [output + (1e-7 if len(batch) > 1 else 0) for output in infer(request, batch)]

    driver = NetworkDriver("chauffeur@openvino")
    given = frames(6)
    expected = [alone(driver, frame) for frame in given]
    monkeypatch.setattr(backends, "_infer", other_bits)
    for _ in range(2):
        sizes.clear()
        found = driver.commands(given)
        assert [(c.steering, c.throttle) for c in found if not isinstance(c, DriverError)] == expected
    assert sizes == [1] * len(given)


def test_an_error_stays_with_its_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    driver = NetworkDriver("chauffeur@openvino")
    given = frames(5)
    expected = [alone(driver, frame) for frame in given]
    compute = driver._pilot._compute  # type: ignore[attr-defined]

    def with_nan(batch: np.ndarray) -> list[np.ndarray]:
        steering = compute(batch)[0].copy()
        steering[2] = np.nan
        return [steering]

    monkeypatch.setattr(driver._pilot, "_compute", with_nan)
    found = driver.commands(given)
    assert isinstance(found[2], DriverError) and "steering is nan" in str(found[2])
    for i in (0, 1, 3, 4):
        assert not isinstance(found[i], DriverError)
        assert (found[i].steering, found[i].throttle) == expected[i]  # type: ignore[union-attr]


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
    assert driver.largest_batch == 1 and driver.rows_seen(Crop(5, 3), 160) is None
    image = np.zeros((160, 320, 3), np.uint8)
    steps = [(0, 1.0), (1, 1.0), (2, 101.0), (3, 1.0), (0, 1.0), (1, 1.0)]
    found = driver.commands([Frame(image=image, speed=speed, step=step) for step, speed in steps])
    assert [None if isinstance(c, DriverError) else c.steering for c in found] == [0.01, 0.02, None, 0.04, 0.01, 0.02]


@pytest.mark.parametrize(("crop", "only"), [("simulator", True), ("none", False), ("{top: 40}", False)])
def test_a_described_network_says_whether_it_keeps_to_the_crop(crop: str, only: bool, tmp_path: Path) -> None:
    from ds_driver.networks.onnx_export import to_onnx

    (tmp_path / "n.onnx").write_bytes(to_onnx(load_weights("dave2")))
    (tmp_path / "n.yaml").write_text(
        f"file: n.onnx\ninput: {{size: [160, 320], colour: yuv, layout: nhwc, type: uint8, crop: {crop}}}\n"
    )
    driver = NetworkDriver(str(tmp_path / "n.yaml"))
    assert (driver.rows_seen(Crop(5, 3), 160) == (5, 157)) is only and driver.largest_batch == 1
    first, second = frames(1)[0], frames(1, seed=6)[0]
    mixed = second.image.copy()
    mixed[54:159] = first.image[54:159]
    same = [alone(driver, Frame(image=image, speed=0.0, crop=Crop(54, 1))) for image in (first.image, mixed)]
    assert (same[0] == same[1]) is only


def test_rows_outside_the_crop_never_matter() -> None:
    driver = NetworkDriver("dave2@openvino")
    given = frames(6)
    rng = np.random.default_rng(7)
    changed = []
    for frame in given:
        image = rng.integers(0, 256, frame.image.shape, dtype=np.uint8)
        rows = slice(frame.crop.top, 160 - frame.crop.bottom)
        image[rows] = frame.image[rows]
        changed.append(Frame(image=image, speed=frame.speed, crop=frame.crop, step=frame.step))
    assert driver.commands(changed) == driver.commands(given)
    assert driver.commands(given[:1]) != driver.commands(given[1:2])


def test_a_pilot_without_batches_predicts_one_by_one() -> None:
    class Echo(Pilot):
        def start(self) -> None: ...

        def predict(self, frame: Frame) -> Prediction:
            return Prediction(float("inf") if frame.speed > 1 else frame.speed)

    found = Echo().predict_batch(frames(4))
    assert [None if isinstance(p, DriverError) else p.steering for p in found] == [0.0, 0.7, None, None]
