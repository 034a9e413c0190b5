# SPDX-License-Identifier: Apache-2.0
"""Compares inference backends on one thread: speed and steering.

`python -m benchmarks.inference` measures Dave-2, Chauffeur and Epoch, alternating between backends, so that a
busy machine slows down all alike. It prints the CPU time of this process, which other programs affect little. The
processor must have bfloat16.

`--roads 2` also compares the steering on frames of drives on that many random roads, on every simulator, with PyTorch.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from ds_driver.closed_loop.simulation import drive_road, make_driver
from ds_driver.data.collection import roads_both_ways
from ds_driver.networks.architectures import NETWORKS
from ds_driver.networks.images import Crop
from ds_driver.networks.network_driver import BuiltInPilot
from ds_driver.networks.pilot import Frame
from ds_driver.networks.weights import load_weights
from ds_road import Road
from ds_sim.registry import STANDARD, make_simulator, spec_of
from ds_sim.simulator import Command, Observation

BACKENDS = ("torch", "onnx", "openvino", "openvino-bf16")
BATCHES = (1, 4, 8)
"""Frames at once, where the backend takes as many with the bits that each gives alone."""


def speed(name: str, frames: int, table: Table) -> None:
    """Add one row per backend and batch: time per frame including preprocessing, ms, and time to load, s."""
    image = np.random.default_rng(1).integers(0, 256, (160, 320, 3), dtype=np.uint8)
    frame = Frame(image=image, speed=5.0, crop=Crop(54, 0))
    pilots, loading = {}, {}
    for backend in BACKENDS:
        started = time.process_time()
        pilots[backend] = BuiltInPilot(load_weights(name), backend)
        pilots[backend].predict(frame)
        loading[backend] = time.process_time() - started
    rows = [(backend, size) for backend, pilot in pilots.items() for size in BATCHES if size <= pilot.largest_batch]
    cpu: dict[tuple[str, int], list[float]] = {row: [] for row in rows}
    for backend, size in rows:
        pilots[backend].predict_batch([frame] * size)  # compiles the graph for this size
    for _ in range(frames):
        for backend, size in rows:
            started = time.process_time()
            pilots[backend].predict_batch([frame] * size)
            cpu[backend, size].append(1e3 * (time.process_time() - started) / size)
    for (backend, size), times in cpu.items():
        first = f"{loading[backend]:.2f}" if size == 1 else ""
        table.add_row(name, backend, str(size), f"{min(times):.2f}", f"{np.median(times):.2f}", first)


def frames_of(driver: str, simulator: str, road: Road, seed: int, every: int) -> list[NDArray[np.uint8]]:
    """Every n-th image that a driver sees on a road; n is `every`."""
    world = make_simulator(simulator)
    drive, images = make_driver(driver, world.spec), []

    def watched(observation: Observation) -> Command:
        if observation.step % every == 0:
            images.append(observation.image.copy())
        return drive(observation)

    drive_road(world, watched, road, seed)
    world.close()
    return images


def differences(name: str, roads: list[Road], console: Console) -> None:
    """Print how much the steering of each backend differs from PyTorch on the same frames."""
    pilots = {backend: BuiltInPilot(load_weights(name), backend) for backend in BACKENDS}
    deviations: dict[str, list[float]] = {backend: [] for backend in BACKENDS[1:]}
    for simulator in STANDARD:
        crop = Crop.of(spec_of(simulator))
        for seed, road in enumerate(roads):
            for image in frames_of(name, simulator, road, seed, 3):
                steering = {b: p.predict(Frame(image=image, speed=0.0, crop=crop)).steering for b, p in pilots.items()}
                for backend, values in deviations.items():
                    values.append(abs(steering[backend] - steering["torch"]))
    table = Table(f"{name}, steering difference to PyTorch", "frames", "median", "95 %", "99 %", "largest")
    for backend, values in deviations.items():
        shares = (f"{v:.1e}" for v in np.percentile(values, (50, 95, 99, 100)))
        table.add_row(backend, str(len(values)), *shares)
    console.print(table)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--roads", type=int, default=0, help="random roads to drive; 0 for timings only")
    parser.add_argument("--seed", type=int, default=424_242, help="seed of the roads")
    parser.add_argument("--networks", default=",".join(NETWORKS))
    arguments = parser.parse_args()
    console = Console(width=120)
    torch.set_num_threads(1)
    table = Table("network", "backend", "batch", "CPU ms, minimum", "median", "loading, CPU s")
    names = arguments.networks.split(",")
    if arguments.frames:
        for name in names:
            speed(name, arguments.frames, table)
        console.print(table)
    if arguments.roads:
        roads = roads_both_ways(arguments.roads, arguments.seed)
        for name in names:
            differences(name, roads, console)


if __name__ == "__main__":
    main()
