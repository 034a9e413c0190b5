"""Starts the node that hosts this package's simulator."""

from __future__ import annotations

from ds_sim.executables import start


def main() -> None:
    """Host the simulator of the parameter `simulator`, which names a file: `ros@FILE`."""
    start("ds_sim.ros.simulator_node", "ros")
