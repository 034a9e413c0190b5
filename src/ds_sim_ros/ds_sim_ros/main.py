"""Starts the node that hosts this package's simulator."""

from __future__ import annotations

from ds_sim.executables import start


def main() -> None:
    """Host `ros` unless the parameter `simulator` names another simulator."""
    start("ds_sim.ros.simulator_node", "ros")
