"""Starts the node that hosts this package's simulator."""

from __future__ import annotations

from ds_sim.node import main as host


def main() -> None:
    """Host `donkey` unless the parameter `simulator` says otherwise."""
    host("donkey")
