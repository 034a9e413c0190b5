# SPDX-License-Identifier: Apache-2.0
"""Networks, generators and data sets that nobody has trained or driven."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper

from ds_driver.data.dataset import drive_path, write_drive
from ds_driver.networks.torch_networks import make_network, save_weights
from ds_driver.sim2real.generator import GeneratorShape, StoredGenerator, Window, load_generator, save_generator
from ds_driver.sim2real.networks import Generator
from ds_sim.camera.encodings import jpeg

TINY = GeneratorShape(filters=2, blocks=1, rows=32, columns=64)
ROAD_ROWS = Window(54, 160, 0, 320)
PHOTOGRAPH = Window(0, 120, 0, 160)


def write_network(path: Path, architecture: str) -> Path:
    """Draw a network whose steering stays within its range, so that nothing is clipped."""
    torch.manual_seed(2)
    network = make_network(architecture)
    with torch.no_grad():
        list(network.parameters())[-2].mul_(0.2)
    save_weights(network, path, architecture=architecture)
    return path


def write_generator(
    path: Path, simulator: str = "bullet", *, seed: int = 1, window: Window = ROAD_ROWS
) -> StoredGenerator:
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(seed)
    tensors = {name: value.numpy() for name, value in Generator(TINY).state_dict().items()}
    save_generator(path, tensors, simulator=simulator, shape=TINY, window=window, real_window=PHOTOGRAPH)
    return load_generator(path)


def write_graph(
    path: Path,
    nodes: Sequence[onnx.NodeProto],
    inputs: Mapping[str, Sequence[int]],
    outputs: Mapping[str, Sequence[int] | None],
    constants: Sequence[onnx.TensorProto] = (),
    *,
    kind: int = TensorProto.FLOAT,
) -> Path:
    """Write an ONNX file; `kind` is the type of its inputs."""
    taken = [helper.make_tensor_value_info(name, kind, shape) for name, shape in inputs.items()]
    answered = [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in outputs.items()]
    graph = helper.make_graph(nodes, "network", taken, answered, constants)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), path)
    return path


def write_recorded(
    data: Path,
    simulator: str,
    images: Sequence[NDArray[np.uint8]],
    steering: Sequence[float],
    *,
    road: str = "r",
    direction: str = "forward",
    every: int = 1,
) -> Path:
    """Write a drive of a data set, of which every so many frames were kept, at a speed of 0.1 m/s."""
    about = {"simulator": simulator, "road_id": road, "direction": direction, "speed": 0.1}
    rows: list[dict[str, object]] = [
        {**about, "image": jpeg(image), "steering": angle, "step": every * number}
        for number, (image, angle) in enumerate(zip(images, steering, strict=True))
    ]
    path = drive_path(data, simulator, road, direction)
    write_drive(path, rows)
    return path
