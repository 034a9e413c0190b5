# SPDX-License-Identifier: Apache-2.0
"""What one core can do, and how near each part of a frame comes to it.

`python -m benchmarks.core_limit` measures multiplications per second in each precision, by products of large matrices
with PyTorch on one thread, and bytes copied per second; counts the multiplications of the networks; and prints what
they would take at that rate beside what they take. All in processor time; the processor must have bfloat16.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np
import onnx
import torch
from rich.console import Console
from rich.table import Table

from ds_driver.networks.images import Crop
from ds_driver.networks.network_driver import BuiltInPilot
from ds_driver.networks.onnx_export import to_onnx
from ds_driver.networks.pilot import Frame
from ds_driver.networks.weights import load_weights
from ds_driver.sim2real.stage import open_set
from ds_driver.sim2real.translator import Translator, generator_to_onnx

SIZE, BATCH, ROUNDS = 2048, 4, 60
PRECISIONS = {"float32": "onnx", "bfloat16": "openvino-bf16", "int8": "openvino-int8"}
"""Precision -> the back end that computes in it."""


def fastest(call: Callable[[], object], rounds: int) -> float:
    """Shortest processor time of a call, s."""
    times = []
    for _ in range(rounds):
        started = time.process_time()
        call()
        times.append(time.process_time() - started)
    return min(times)


def rates() -> dict[str, float]:
    """Multiplications per second in each precision."""
    torch.set_num_threads(1)
    left, right = torch.rand(SIZE, SIZE), torch.rand(SIZE, SIZE)
    halves = left.bfloat16(), right.bfloat16()
    bytes_ = (left * 100).to(torch.int8), (right * 100).to(torch.int8)
    calls = {
        "float32": lambda: left @ right,
        "bfloat16": lambda: halves[0] @ halves[1],
        "int8": lambda: torch._int_mm(*bytes_),
    }
    return {name: SIZE**3 / fastest(call, 10) for name, call in calls.items()}


def multiplications(content: bytes) -> int:
    """Multiplications of one image through the convolutions and dense layers of an ONNX graph."""
    graph = onnx.shape_inference.infer_shapes(onnx.load_from_string(content)).graph
    shapes = {
        value.name: [max(d.dim_value, 1) for d in value.type.tensor_type.shape.dim]
        for value in (*graph.value_info, *graph.output, *graph.input)
    }
    weights = {one.name: list(one.dims) for one in graph.initializer}
    total = 0
    for node in graph.node:
        if node.op_type not in ("Conv", "ConvTranspose", "Gemm", "MatMul"):
            continue
        kernel = weights[node.input[1]]
        # Each weight of a convolution is used once for each place of its output; of a transposed one, of its input.
        places = shapes[node.input[0] if node.op_type == "ConvTranspose" else node.output[0]][2:]
        total += math.prod(kernel) * math.prod(places)
    return total


def main() -> None:
    """Print both tables."""
    found = rates()
    block = np.ones(64 * 2**20, np.uint8)
    copied = block.size / fastest(lambda: block.copy(), 10)
    print(", ".join(f"{name} {rate / 1e9:.0f} G" for name, rate in found.items()), "multiplications a second;", end=" ")
    print(f"{copied / 1e9:.1f} GB a second copied")
    image = np.random.default_rng(1).integers(0, 256, (160, 320, 3), dtype=np.uint8)
    stored = open_set("indoor_track").generator("bullet")
    table = Table(
        "network", "precision", "multiplications", "limit, ms", f"a batch of {BATCH} takes, ms an image", "times limit"
    )
    for name in ("dave2", "chauffeur", "epoch", "generator"):
        content = generator_to_onnx(stored) if name == "generator" else to_onnx(load_weights(name))
        count = multiplications(content)
        for precision, backend in PRECISIONS.items():
            if name == "generator":
                translator = Translator(stored, backend)
                seconds = fastest(lambda t=translator: t.translate_all([image] * BATCH), ROUNDS)  # type: ignore[misc]
            else:
                pilot, frames = BuiltInPilot(name, backend), [Frame(image=image, speed=5.0, crop=Crop(54, 0))] * BATCH
                seconds = fastest(lambda p=pilot, f=frames: p.predict_batch(f), ROUNDS)  # type: ignore[misc]
            limit, taken = count / found[precision], seconds / BATCH
            table.add_row(
                name, precision, f"{count / 1e6:.0f} M", f"{1e3 * limit:.2f}", f"{1e3 * taken:.2f}",
                f"{taken / limit:.1f}",
            )  # fmt: skip
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
