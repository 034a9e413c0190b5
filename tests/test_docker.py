# SPDX-License-Identifier: Apache-2.0
"""Container files, checked without a container engine: commands, names and paths exist in the workspace."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import yaml

ROOT = Path.cwd()
SERVICES: dict[str, Any] = yaml.safe_load((ROOT / "docker/compose.yaml").read_text())["services"]
DRIVER = yaml.safe_load((ROOT / "src/ds_bringup/config/driver.yaml").read_text())["/driver"]["ros__parameters"]
DEMO = yaml.safe_load((ROOT / "src/ds_bringup/config/demo.yaml").read_text())


def test_every_command_is_an_executable_of_the_workspace() -> None:
    for name, service in SERVICES.items():
        command = service["command"]
        if name != "pod":
            assert command[:2] == ["ros2", "run"], name
            assert (ROOT / "ros_ws/install" / command[2] / "lib" / command[2] / command[3]).is_file(), name


def test_the_driver_serves_every_simulator_and_is_the_campaigns() -> None:
    spaces = [c for s in SERVICES.values() for c in s["command"] if c.startswith("__ns:=")]
    assert [space.removeprefix("__ns:=") for space in spaces] == DRIVER["namespaces"]
    assert SERVICES["driver"]["command"][-1] == "src/ds_bringup/config/driver.yaml"
    assert DEMO["driver"] == DRIVER["network"] and "demo.yaml" in SERVICES["campaign"]["command"][4]


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
