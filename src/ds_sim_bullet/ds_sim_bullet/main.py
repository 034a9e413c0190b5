"""Starts the node that hosts this package's simulator."""

from __future__ import annotations

from ds_sim.node import main as host


def main() -> None:
    """Host `bullet` unless the parameter `simulator` says otherwise."""
    host("bullet")
