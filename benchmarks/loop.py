"""Speed of the closed loop through ROS, and where the time is spent.

`python benchmarks/loop.py [--driver dave2] [--roads 5]` prints, per simulator, the frames per second of a simulator
node and a driver node in lockstep, and the parts of a frame, measured in this process: physics, camera, network. The
remainder is transport: messages, scheduling, waking up, loading the road and returning the result.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from ds_driver.control.autopilot import Autopilot
from ds_driver.networks.network_driver import NetworkDriver
from ds_driver.networks.preprocessing import Crop
from ds_orchestrator.graph.session import running_graph
from ds_road import Road, generate
from ds_sim.registry import SIMULATORS, make_simulator
from ds_sim.road_simulator import RoadSimulator
from ds_sim.simulator import FRAME_RATE, Outcome


def loop(name: str, driver: str, roads: list[Road]) -> tuple[float, float]:
    """Time per frame through ROS, ms: median over the roads, and how much longer the slowest road takes."""
    space = {name: "/ds1"}
    with (
        tempfile.TemporaryDirectory() as logs,
        running_graph(space, driver, command_timeout=10.0, logs=Path(logs)) as executor,
    ):
        executor.execute(name, roads[0], 0)
        per_frame = []
        for road in roads:
            started = time.perf_counter()
            steps = executor.execute(name, road, 0).steps
            per_frame.append(1e3 * (time.perf_counter() - started) / steps)
    median = statistics.median(per_frame)
    return median, max(per_frame) - median


def parts(name: str, driver: NetworkDriver, roads: list[Road]) -> dict[str, float]:
    """Median time of each part of a frame in this process, ms."""
    simulator = make_simulator(name)
    assert isinstance(simulator, RoadSimulator)
    crop = Crop(simulator.spec.crop_top, simulator.spec.crop_bottom)
    vehicle = simulator.vehicle
    times: dict[str, list[float]] = {"physics": [], "camera and lane": [], "network": []}
    advance = vehicle.advance

    for road in roads:
        pilot = Autopilot(simulator.spec.autopilot)
        observation = simulator.load(road, seed=0)
        while observation.outcome is Outcome.RUNNING:
            command = pilot.command(observation.lane.preview_lateral_position, observation.vehicle.speed)
            spent = [0.0]

            def timed(command: object, spent: list[float] = spent) -> None:
                started = time.perf_counter()
                advance(command)  # type: ignore[arg-type]
                spent[0] = time.perf_counter() - started

            vehicle.advance = timed  # type: ignore[method-assign, assignment]
            started = time.perf_counter()
            observation = simulator.step(command)
            times["camera and lane"].append(time.perf_counter() - started - spent[0])
            times["physics"].append(spent[0])
            started = time.perf_counter()
            driver.command(observation.image, observation.vehicle.speed, crop)
            times["network"].append(time.perf_counter() - started)
    simulator.close()
    return {part: 1e3 * float(np.median(values)) for part, values in times.items()}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--driver", default="dave2")
    parser.add_argument("--roads", type=int, default=5)
    parser.add_argument("--sims", default=",".join(SIMULATORS))
    arguments = parser.parse_args()
    roads = [generate(np.random.default_rng(seed), max_angle=120) for seed in range(arguments.roads)]
    table = Table(
        "simulator", "frames/s", "x real time", "frame ms", "physics", "camera, lane", "network", "transport", "spread"
    )
    network = NetworkDriver(arguments.driver)
    for name in arguments.sims.split(","):
        frame, spread = loop(name, arguments.driver, roads)
        cost = parts(name, network, roads[:2])
        transport = frame - sum(cost.values())
        rate = 1e3 / frame
        table.add_row(
            name, f"{rate:.0f}", f"{rate / FRAME_RATE:.1f}", f"{frame:.2f}", f"{cost['physics']:.2f}",
            f"{cost['camera and lane']:.2f}", f"{cost['network']:.2f}", f"{transport:.2f}", f"{spread:.2f}",
        )  # fmt: skip
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
