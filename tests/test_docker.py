# SPDX-License-Identifier: Apache-2.0
"""Container files, checked without a container engine: commands, names and paths exist in the workspace."""

from __future__ import annotations

import subprocess
from pathlib import Path

ROOT = Path.cwd()


def test_the_entry_point_finds_ros_and_the_verbs_in_an_empty_environment() -> None:
    def run(*command: str) -> str:
        clean = {"PATH": "/usr/bin:/bin", "HOME": "/tmp"}
        answer = subprocess.run(
            [ROOT / "docker/entrypoint.sh", *command], env=clean, cwd="/", capture_output=True, text=True, timeout=60
        )
        assert answer.returncode == 0, answer.stderr
        return answer.stdout

    assert run("python", "-c", "import rclpy, ds_interfaces.msg; print('ROS')") == "ROS\n"
    assert '"dave2"' in run("ds", "models", "--json")
