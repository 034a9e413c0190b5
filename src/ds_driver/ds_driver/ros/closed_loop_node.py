# SPDX-License-Identifier: Apache-2.0
"""Runs a simulator's node and its driver's node in one process, each with its topics, services and parameters.

Messages between the two stay in the process. Each node has a thread of its own, so that the simulator answers a cancel
or a reset, and its watchdog ends the run, while the driver's network hangs.
"""

from __future__ import annotations

import sys
from importlib import import_module
from typing import Any, cast

from rclpy.node import Node
from rclpy.utilities import remove_ros_args

from ds_sim.registry import SimulatorName
from ds_sim.ros.parameters import declare
from ds_sim.ros.runtime import run_node
from ds_sim.ros.simulator_node import SimulatorNode

DRIVERS = {
    "driver": ("ds_driver.ros.driver_node", "DriverNode"),
    "autopilot": ("ds_driver.ros.autopilot_node", "AutopilotNode"),
}
"""Argument of the command line -> module and class of the driver's node."""


def main() -> None:
    """Run both nodes until a signal stops them; the argument names the driver's node, `driver` by default."""
    arguments = remove_ros_args(sys.argv)[1:]
    kind = arguments[0] if arguments else "driver"
    if kind not in DRIVERS or len(arguments) > 1:
        print(
            f"error: {' '.join(arguments)!r} names no driver's node: expected {' or '.join(DRIVERS)}", file=sys.stderr
        )
        sys.exit(2)
    simulators: list[SimulatorNode] = []

    def make_simulator() -> Node:
        simulators.append(SimulatorNode(SimulatorName("bullet")))
        return simulators[0]

    sys.exit(run_node(make_simulator, lambda: _make_driver(kind, simulators[0])))


def _make_driver(kind: str, simulator: SimulatorNode) -> Node:
    """Make the driver's node; with `draw:=seen` the simulator draws the rows that it sees."""
    module, name = DRIVERS[kind]
    driver: Any = getattr(import_module(module), name)()
    about = "all: the simulator draws whole images; seen: rows that the driver sees, unless another node subscribes."
    if declare(simulator, "draw", "all", about, choices=("all", "seen")) == "seen":
        simulator.drawn.draw_for(driver.rows_seen, subscriptions=int(kind == "driver"))
    return cast(Node, driver)


if __name__ == "__main__":
    main()
