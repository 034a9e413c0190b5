"""Verbs as ROS executables, for people who start their own nodes: `ros2 run ds_orchestrator campaign ...`.

They take `ds`'s arguments, attach to the nodes that run already, and leave ROS's own arguments to ROS.
"""

from __future__ import annotations

import sys

from rclpy.utilities import remove_ros_args

from ds_orchestrator.cli import main as cli


def campaign() -> None:
    """`campaign CONFIG.yaml --out DIR` with running nodes."""
    _attached(["campaign", "run"])


def drive() -> None:
    """`drive --sim NAME ...` with running nodes."""
    _attached(["drive"])


def demo() -> None:
    """`demo --out DIR` with running nodes."""
    _attached(["demo"])


def _attached(verb: list[str]) -> None:
    sys.argv = [f"ds {' '.join(verb)}", *verb, *remove_ros_args(sys.argv)[1:], "--attach"]
    cli.main()
