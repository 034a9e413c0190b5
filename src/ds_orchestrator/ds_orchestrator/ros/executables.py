"""Verbs of `ds` as ROS executables, for graphs started by launch files: `ros2 run ds_orchestrator campaign ...`.

They take the arguments of the verb, attach to the running nodes, and ignore ROS arguments.
"""

from __future__ import annotations

import sys

from rclpy.utilities import remove_ros_args

from ds_orchestrator.cli import main as cli


def campaign() -> None:
    """Run `ds campaign run CONFIG.yaml --out DIR --attach`."""
    _attached(["campaign", "run"])


def drive() -> None:
    """Run `ds drive --sim NAME ... --attach`."""
    _attached(["drive"])


def demo() -> None:
    """Run `ds demo --out DIR --attach`."""
    _attached(["demo"])


def _attached(verb: list[str]) -> None:
    sys.argv = [f"ds {' '.join(verb)}", *verb, *remove_ros_args(sys.argv)[1:], "--attach"]
    cli.main()
