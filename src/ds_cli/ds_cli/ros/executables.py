# SPDX-License-Identifier: Apache-2.0
"""Verbs of `ds` as ROS executables, for graphs started by launch files: `ros2 run ds_orchestrator campaign ...`.

They take the arguments of the verb and ignore ROS arguments; all but `watch` attach to the running nodes. Stopped by a
signal they end with status 0, as nodes do: `ros2 launch` reports `process has died` for any other.
"""

from __future__ import annotations

import sys

from rclpy.utilities import remove_ros_args

from ds_cli import main as cli
from ds_orchestrator.graph.signals import exit_status

VERBS = {"campaign": (["campaign", "run"], ["--attach"]), "drive": (["drive"], ["--attach"]), "watch": (["watch"], [])}
"""Executable -> verb, and the options that it adds."""


def main(name: str) -> None:
    """Run an executable: a verb, or `orchestrator`, the node that takes campaigns and tests as goals."""
    if name == "orchestrator":
        from ds_studies.ros import orchestrator_node

        orchestrator_node.main()
        return
    verb, options = VERBS[name]
    sys.argv = [f"ds {' '.join(verb)}", *verb, *remove_ros_args(sys.argv)[1:], *options]
    try:
        cli.main()
    except SystemExit as end:
        sys.exit(0 if end.code == exit_status() else end.code)
