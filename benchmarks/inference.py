"""What computes a network fastest with one thread, how far the answers differ, and whether a drive ends differently.

`python benchmarks/inference.py` measures Dave-2, Chauffeur and Epoch, turn by turn, so that a busy machine is equally
slow for all. It gives the processor time of this process, which other programs disturb little, and the time on the
wall.

`--roads 17` also drives so many random roads in both directions on every simulator with each backend (17: 102 drives
each), holds the outcomes against PyTorch's, and compares the steering on frames of PyTorch's drives.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from ds_driver.closed_loop.simulation import Drive, drive_all, make_driver
from ds_driver.data.collection import roads_both_ways
from ds_driver.data.crops import simulator_crop
from ds_driver.networks.architectures import NETWORKS
from ds_driver.networks.backends import with_backend
from ds_driver.networks.network_driver import BuiltInPilot
from ds_driver.networks.pilot import Frame
from ds_driver.networks.preprocessing import Crop
from ds_road import Road
from ds_sim.registry import SIMULATORS, make_simulator
from ds_sim.session import RunRecord
from ds_sim.simulator import Outcome

BACKENDS = ("torch", "onnx", "openvino")


def speed(name: str, frames: int, table: Table) -> None:
    """Milliseconds a frame with its preprocessing, and seconds to load, one row a backend."""
    image = np.random.default_rng(1).integers(0, 256, (160, 320, 3), dtype=np.uint8)
    seen = Frame(image=image, speed=5.0, crop=Crop(54, 0))
    pilots, loading = {}, {}
    for backend in BACKENDS:
        started = time.process_time()
        pilots[backend] = BuiltInPilot(name, backend)
        pilots[backend].predict(seen)
        loading[backend] = time.process_time() - started
    busy: dict[str, list[float]] = {backend: [] for backend in BACKENDS}
    wall: dict[str, list[float]] = {backend: [] for backend in BACKENDS}
    for _ in range(frames):
        for backend, pilot in pilots.items():
            begin, began = time.process_time(), time.perf_counter()
            pilot.predict(seen)
            busy[backend].append(1e3 * (time.process_time() - begin))
            wall[backend].append(1e3 * (time.perf_counter() - began))
    for backend in BACKENDS:
        median, least = np.median(busy[backend]), min(busy[backend])
        table.add_row(
            name, backend, f"{least:.2f}", f"{median:.2f}", f"{min(wall[backend]):.2f}",
            f"{np.median(wall[backend]):.2f}", f"{loading[backend]:.2f}",
        )  # fmt: skip


def frames_of(driver: str, simulator: str, road: Road, seed: int, every: int) -> Iterator[NDArray[np.uint8]]:
    """Some of the images that a driver sees on a road."""
    world = make_simulator(simulator)
    drive = make_driver(driver, world.spec)
    seen = world.load(road, seed=seed)
    while seen.outcome is Outcome.RUNNING:
        if seen.step % every == 0:
            yield seen.image
        seen = world.step(drive(seen))
    world.close()


def differences(name: str, roads: list[Road], console: Console) -> None:
    """How far each backend steers from PyTorch on the same frames."""
    pilots = {backend: BuiltInPilot(name, backend) for backend in BACKENDS}
    apart: dict[str, list[float]] = {backend: [] for backend in BACKENDS[1:]}
    for simulator in SIMULATORS:
        crop = simulator_crop(simulator)
        for seed, road in enumerate(roads[:2]):
            for image in frames_of(name, simulator, road, seed, 3):
                said = {b: p.predict(Frame(image=image, speed=0.0, crop=crop)).steering for b, p in pilots.items()}
                for backend, values in apart.items():
                    values.append(abs(said[backend] - said["torch"]))
    table = Table(f"{name}, steering apart from PyTorch", "frames", "median", "95 %", "99 %", "largest")
    for backend, values in apart.items():
        shares = (f"{v:.1e}" for v in np.percentile(values, (50, 95, 99, 100)))
        table.add_row(backend, str(len(values)), *shares)
    console.print(table)


def outcomes(name: str, roads: list[Road], console: Console) -> None:
    """Drive every road in both directions on every simulator with each backend."""
    ways = [way for road in roads for way in (road, road.reversed())]
    runs: dict[str, list[RunRecord]] = {}
    for backend in BACKENDS:
        named = with_backend(name, backend)
        drives = [Drive(s, named, road, seed) for s in SIMULATORS for seed, road in enumerate(ways)]
        runs[backend] = list(drive_all(drives))
    table = Table(f"{name}, {len(runs['torch'])} drives", "outcomes", "other than PyTorch's", "fitness apart, m")
    for backend, found in runs.items():
        pairs = list(zip(runs["torch"], found, strict=True))
        counts = ", ".join(f"{n} {o.name.lower()}" for o, n in sorted(Counter(r.outcome for r in found).items()))
        gaps = [abs(a.fitness - b.fitness) for a, b in pairs if a.outcome is b.outcome and a.outcome.is_verdict]
        other = sum(a.outcome is not b.outcome for a, b in pairs)
        table.add_row(
            backend, counts, str(other), f"median {np.median(gaps):.1e}, largest {max(gaps, default=0.0):.1e}"
        )
    console.print(table)


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--roads", type=int, default=0, help="random roads to drive; 0 measures time alone")
    parser.add_argument("--seed", type=int, default=424_242, help="of the roads")
    parser.add_argument("--networks", default=",".join(NETWORKS))
    arguments = parser.parse_args()
    console = Console(width=120)
    torch.set_num_threads(1)
    table = Table("network", "backend", "busy ms, least", "median", "wall ms, least", "median", "loading, busy s")
    names = arguments.networks.split(",")
    if arguments.frames:
        for name in names:
            speed(name, arguments.frames, table)
        console.print(table)
    if arguments.roads:
        roads = roads_both_ways(arguments.roads, arguments.seed)
        for name in names:
            differences(name, roads, console)
            outcomes(name, roads, console)


if __name__ == "__main__":
    main()
