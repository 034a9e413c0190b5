"""Processor time that conditions cost on each simulator: loading a road, and drawing a frame.

python benchmarks/conditions/costs.py [--frames 40]
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from ds_road import generate
from ds_sim.conditions.text import parse_conditions
from ds_sim.registry import SIMULATORS, make_simulator
from ds_sim.road_simulator import RoadSimulator
from ds_sim.simulator import VehicleState

CASES = (
    "", "line_contrast=0.4", "shadow_density=0.4", "repair_share=0.3", "visibility=60", "low_sun=5000", "lens_dirt=0.2",
    "camera_pitch=3deg", "line_contrast=0.4,shadow_density=0.4,visibility=60,lens_dirt=0.2,low_sun=5000",
)  # fmt: skip


def main() -> None:
    """Print one line per simulator and case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--sim", nargs="*", default=list(SIMULATORS))
    arguments = parser.parse_args()
    road = generate(np.random.default_rng(1), max_angle=120)
    lane = road.lane_centre
    states = [
        VehicleState(x=float(x), y=float(y), yaw=1.57, speed=5.0, yaw_rate=0.0, steering_angle=0.0)
        for x, y in lane[: arguments.frames]
    ]
    for name in arguments.sim:
        simulator = make_simulator(name)
        assert isinstance(simulator, RoadSimulator)
        scene = simulator.scene
        for text in CASES:
            conditions = parse_conditions(text)
            scene.load(road, np.random.default_rng(1), conditions)
            scene.image(states[0])
            begun = time.process_time()
            scene.load(road, np.random.default_rng(1), conditions)
            loaded = time.process_time()
            for state in states:
                scene.image(state)
            drawn = time.process_time()
            frame = 1000.0 * (drawn - loaded) / len(states)
            print(
                f"{name:9} load {1000.0 * (loaded - begun):6.0f} ms  frame {frame:5.2f} ms  {text or 'default'}",
                flush=True,
            )


if __name__ == "__main__":
    main()
