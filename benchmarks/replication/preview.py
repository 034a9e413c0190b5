# SPDX-License-Identifier: Apache-2.0
"""What the autopilot's preview point changes: it drives on it, and on the lateral position as in equation 1 (3.2.1).

`python -m benchmarks.replication.preview` prints, for each simulator of the campaign, how many roads are completed and
how near the vehicle comes to the edge of its lane, on average over the roads.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ds_driver.closed_loop.simulation import drive_road
from ds_driver.control.autopilot import ROWS_SEEN, Autopilot
from ds_driver.data.collection import roads_both_ways
from ds_sim.registry import make_simulator
from ds_sim.simulator import AutopilotGains, Command, Observation, Outcome, Simulator

ROADS, SEED = 25, 424242
"""As on the cards of the shipped networks."""
SIMULATORS = ("bullet", "softbody", "donkey")
DERIVATIVE = 20.0
"""Derivative gain of the third way, in proportional gains; the largest of 5, 10 and 20, which were tried."""


def completed(simulator: Simulator, gains: AutopilotGains, *, preview: bool) -> tuple[int, float]:
    """Number of completed roads, and the mean of the smallest lateral distances, m."""
    found = []
    for number, road in enumerate(roads_both_ways(ROADS, SEED)):
        autopilot = Autopilot(gains)

        def driver(seen: Observation, autopilot: Autopilot = autopilot) -> Command:
            lane = seen.lane
            position = lane.preview_lateral_position if preview else lane.lateral_position
            return autopilot.command(position, seen.vehicle.speed)

        found.append(drive_road(simulator, driver, road, number))
    return sum(one.outcome is Outcome.COMPLETED for one in found), float(np.mean([one.fitness for one in found]))


def main() -> None:
    """Drive, and print the page's table."""
    for name in SIMULATORS:
        simulator = make_simulator(name)
        simulator.draw_rows(*ROWS_SEEN)
        gains = simulator.spec.autopilot
        damped = replace(gains, derivative=DERIVATIVE * gains.proportional)
        ways = ((gains, True), (gains, False), (damped, False))
        found = [completed(simulator, one, preview=preview) for one, preview in ways]
        print(f"| {name} | {' | '.join(f'{roads} of {ROADS}, {distance:.2f} m' for roads, distance in found)} |")
        simulator.close()


if __name__ == "__main__":
    main()
