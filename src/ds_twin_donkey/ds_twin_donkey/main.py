"""Starts the node that hosts this package's simulator."""

from __future__ import annotations

from ds_sim.executables import start


def main() -> None:
    """Host `donkey` unless the parameter `simulator` says otherwise."""
    start("ds_sim.ros.simulator_node", "donkey")
