# SPDX-License-Identifier: Apache-2.0
"""Speed of the closed loop through ROS, and where the time is spent.

`python -m benchmarks.loop [--driver dave2] [--sims bullet] [--roads 3]` prints, per simulator, frames per second of
processor time (of all processes of the graph and of the client) and of the wall clock, with one process per node and
with the simulator and its driver in one process. Below: the parts of a frame without ROS, measured in the same minutes,
as a busy machine halves everything.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from benchmarks.campaign import processor_time
from rich.console import Console
from rich.table import Table

from ds_driver.networks.network_driver import NetworkDriver
from ds_driver.networks.pilot import Frame
from ds_orchestrator.graph.session import running_graph
from ds_road import Road, generate
from ds_sim.registry import make_simulator
from ds_sim.road_simulator import RoadSimulator
from ds_sim.simulator import Outcome

Total = tuple[int, float, float]
"""Frames, processor time in s, and wall time in s."""


def parts(name: str, driver: NetworkDriver, road: Road) -> dict[str, Total]:
    """Cost of each part of the frames of a road in this process, without ROS."""
    simulator = make_simulator(name)
    assert isinstance(simulator, RoadSimulator)
    spent = dict.fromkeys(("physics", "camera, lane", "network"), 0.0)
    advance = simulator.vehicle.advance

    def physics(command: object) -> None:
        began = time.process_time()
        advance(command)  # type: ignore[arg-type]
        spent["physics"] += time.process_time() - began

    simulator.vehicle.advance = physics  # type: ignore[method-assign, assignment]
    observation, frames = simulator.load(road, seed=0), 0
    while observation.outcome is Outcome.RUNNING:
        began = time.process_time()
        command = driver.command(Frame.of(observation, simulator.spec))
        answered = time.process_time()
        observation = simulator.step(command)
        spent["network"] += answered - began
        spent["camera, lane"] += time.process_time() - answered
        frames += 1
    simulator.close()
    spent["camera, lane"] -= spent["physics"]
    return {part: (frames, seconds, 0.0) for part, seconds in spent.items()}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--driver", default="dave2")
    parser.add_argument("--roads", type=int, default=3)
    parser.add_argument("--sims", default="bullet")
    arguments = parser.parse_args()
    roads = [generate(np.random.default_rng(seed), max_angle=120) for seed in range(arguments.roads)]
    totals: dict[str, list[Total]] = {}
    network = NetworkDriver(arguments.driver)
    for name in arguments.sims.split(","):
        with ExitStack() as stack:
            graphs = {
                f"{name}, {title}": stack.enter_context(
                    running_graph(
                        {name: "/ds1"}, arguments.driver, command_timeout=10.0,
                        logs=Path(stack.enter_context(tempfile.TemporaryDirectory())), composed=composed, draw="seen",
                    )
                )
                for title, composed in (("a process each", False), ("one process", True))
            }  # fmt: skip
            for graph in graphs.values():
                graph.execute(name, roads[0], 0)  # warm caches
            for road in roads:
                for title, graph in graphs.items():
                    wall, cpu = time.perf_counter(), processor_time()
                    steps = graph.execute(name, road, 0).steps
                    total = (steps, processor_time() - cpu, time.perf_counter() - wall)
                    totals.setdefault(title, []).append(total)
                for part, total in parts(name, network, road).items():
                    totals.setdefault(f"{name}, no ROS: {part}", []).append(total)
    table = Table("", "ms a frame, processor", "frames per processor second", "frames per second")
    for title, rows in totals.items():
        frames, cpu, wall = (sum(column) for column in zip(*rows, strict=True))
        if "no ROS" in title:
            table.add_row(title, f"{1e3 * cpu / frames:.2f}", "", "")
        else:
            table.add_row(title, f"{1e3 * cpu / frames:.2f}", f"{frames / cpu:.0f}", f"{frames / wall:.0f}")
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
