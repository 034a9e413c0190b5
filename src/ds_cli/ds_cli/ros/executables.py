# SPDX-License-Identifier: Apache-2.0
"""Verbs of `ds` as ROS executables, for graphs started by launch files: `ros2 run ds_orchestrator campaign ...`.

They take the arguments of the verb and ignore ROS arguments; all but `watch` attach to the running nodes.
"""

from __future__ import annotations

import sys

from rclpy.utilities import remove_ros_args

from ds_base.executables import start
from ds_cli import main as cli


def orchestrator() -> None:
    """Run the node that takes campaigns and tests as goals."""
    start("ds_studies.ros.orchestrator_node")


def campaign() -> None:
    """Run `ds campaign run CONFIG.yaml --out DIR --attach`."""
    _attached(["campaign", "run"])


def drive() -> None:
    """Run `ds drive --sim NAME ... --attach`."""
    _attached(["drive"])


def watch() -> None:
    """Run `ds watch DIR`."""
    _run(["watch"])


def _attached(verb: list[str]) -> None:
    _run(verb, "--attach")


def _run(verb: list[str], *options: str) -> None:
    sys.argv = [f"ds {' '.join(verb)}", *verb, *remove_ros_args(sys.argv)[1:], *options]
    cli.main()
