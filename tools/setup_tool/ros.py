# SPDX-License-Identifier: Apache-2.0
"""Finds ROS 2, an installed Jazzy that the user has sourced, or adapts the wheels in .venv to this machine."""

from __future__ import annotations

import json
import os
import re
import subprocess
from collections.abc import Mapping
from pathlib import Path

from setup_tool.console import SetupError

DISTRIBUTION = "jazzy"
BOOTSTRAP_DONE = "_ROS_WHEELS_BOOTSTRAP_COMPLETE"
"""States that LD_LIBRARY_PATH holds the wheels' libraries; without it, Python restarts itself."""

_ROS_VARIABLES = re.compile(
    r"AMENT_|COLCON_|ROS_(DISTRO|VERSION|PYTHON_VERSION|ETC_DIR|PACKAGE_PATH)|CMAKE_PREFIX_PATH$"
)
_PYTHON_VARIABLES = (
    *("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV", BOOTSTRAP_DONE),
    # Without bytecode, each of the hundreds of Python processes of a build would compile its modules again.
    *("PYTHONDONTWRITEBYTECODE", "PYTHONPYCACHEPREFIX"),
)
_ASK = """
import json, sysconfig
import numpy
print(json.dumps([sysconfig.get_paths()["include"], numpy.get_include()]))
"""
_BUILDER = r'/opt/python/[^/;"]+'
"""Path of Python on the machine that built the wheels, as in their exported CMake targets."""
_NUMPY_HEADERS = re.compile(_BUILDER + r"/lib/python[\d.]+/site-packages/numpy/_core/include")
_PYTHON_HEADERS = re.compile(_BUILDER + r"/include/python[\d.]+")


def sourced_prefix(environment: Mapping[str, str], root: Path) -> Path | None:
    """Find the folder of an installed ROS 2 Jazzy that the environment has sourced.

    Args:
        environment: variables of the user's shell.
        root: root of the project; prefixes in it do not count, so that its own set-up file may be sourced.
    """
    if environment.get("ROS_DISTRO") != DISTRIBUTION:
        return None
    for entry in environment.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        prefix = Path(entry)
        if not entry or root in prefix.parents or not (prefix / "setup.bash").is_file():
            continue
        if (prefix / "share/ament_index/resource_index/packages/rclpy").is_file():
            return prefix
    return None


def clean_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """Copy the user's environment without any ROS or Python environment."""
    prefixes = [Path(p) for p in environment.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    clean = {}
    for name, value in environment.items():
        if _ROS_VARIABLES.match(name) or name in _PYTHON_VARIABLES:
            continue
        if name in ("PATH", "LD_LIBRARY_PATH"):
            entries = [e for e in value.split(os.pathsep) if e and not _lies_in(Path(e), prefixes)]
            if not entries:
                continue
            value = os.pathsep.join(entries)
        clean[name] = value
    return clean


def environment_after(script: Path, environment: Mapping[str, str]) -> dict[str, str]:
    """Read the environment variables after sourcing a bash script.

    Raises:
        SetupError: the script is missing or fails.
    """
    try:
        answer = subprocess.run(
            ["bash", "-c", '. "$1" >/dev/null && exec env -0', "bash", str(script)],
            env=dict(environment),
            capture_output=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        raise SetupError(f"{script} cannot be sourced: is that ROS still there? `make clean`, then again") from None
    pairs = (entry.partition("=") for entry in answer.stdout.decode(errors="replace").split("\0") if entry)
    return {name: value for name, _, value in pairs if name != "_"}


def environment_of_wheels(environment: Path, variables: Mapping[str, str]) -> dict[str, str]:
    """Add to variables what an installed ROS would set, for the wheels in a virtual environment.

    Args:
        environment: root of the virtual environment.
        variables: without another ROS or Python.
    """
    libraries = [environment / "lib", *sorted(environment.glob("lib/python3.*/site-packages/ros_*.libs"))]
    present = [p for p in variables.get("LD_LIBRARY_PATH", "").split(os.pathsep) if p]
    return {
        **variables,
        **dict.fromkeys(("AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH"), str(environment)),
        "LD_LIBRARY_PATH": os.pathsep.join([*present, *map(str, libraries)]),
        BOOTSTRAP_DONE: "1",
    }


def adapt_wheels(environment: Path, variables: Mapping[str, str]) -> None:
    """Replace the CMake paths of the machine that built the ROS wheels by those of this one.

    Args:
        environment: root of the virtual environment.
        variables: environment variables, without those of another Python.

    Raises:
        SetupError: the virtual environment is not complete.
    """
    python = environment / "bin/python"
    try:
        answer = subprocess.run([python, "-c", _ASK], env=dict(variables), capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError) as error:
        reason = (getattr(error, "stderr", "") or str(error)).strip().splitlines()[-1]
        raise SetupError(f"the virtual environment is not complete ({reason}): `make clean`, then again") from None
    python_headers, numpy_headers = json.loads(answer.stdout)
    for export in environment.glob("share/*/cmake/*Export.cmake"):
        text = export.read_text()
        fixed = _NUMPY_HEADERS.sub(lambda _: numpy_headers, text)
        fixed = _PYTHON_HEADERS.sub(lambda _: python_headers, fixed)
        if fixed != text:
            export.write_text(fixed)


def _lies_in(path: Path, folders: list[Path]) -> bool:
    return any(folder == path or folder in path.parents for folder in folders)
