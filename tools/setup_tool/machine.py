# SPDX-License-Identifier: Apache-2.0
"""Requirements on the machine: a supported Python, its headers, venv, a compiler, and a renderer for one simulator."""

from __future__ import annotations

import ctypes
import json
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from setup_tool.console import SetupError

PYTHON_VERSIONS = ((3, 12), (3, 11))
"""Versions for which all wheels exist, preferred first (ROS 2 Jazzy has 3.12)."""

_DRIVER_FOLDERS = (Path("/usr/lib/x86_64-linux-gnu/dri"), Path("/usr/lib64/dri"), Path("/usr/lib/dri"))
"""Mesa's drivers on Debian and Ubuntu, on Fedora, and on Arch."""

_DESCRIBE = """
import importlib.util, json, os, sys, sysconfig
print(json.dumps({
    "executable": getattr(sys, "_base_executable", None) or sys.executable,
    "version": list(sys.version_info[:3]),
    "has_headers": os.path.isfile(os.path.join(sysconfig.get_paths()["include"], "Python.h")),
    "has_venv": all(importlib.util.find_spec(m) for m in ("venv", "ensurepip")),
    "has_rclpy": importlib.util.find_spec("rclpy") is not None,
}))
"""


@dataclass(frozen=True)
class Python:
    """Python interpreter, as it describes itself."""

    executable: Path
    version: tuple[int, int, int]
    has_headers: bool
    has_venv: bool
    has_rclpy: bool

    @property
    def fits(self) -> bool:
        """Whether the project supports this version."""
        return self.version[:2] in PYTHON_VERSIONS


@dataclass(frozen=True)
class Need:
    """Something that the system lacks, and the Debian package that provides it."""

    what: str
    package: str


def describe(command: str | Path, variables: Mapping[str, str] | None = None) -> Python | None:
    """Ask an interpreter for its description, with these variables or those of this process; None if it fails."""
    try:
        answer = subprocess.run(
            [str(command), "-c", _DESCRIBE],
            env=None if variables is None else dict(variables),
            capture_output=True,
            text=True,
            check=True,
            timeout=30,
        )
        facts = json.loads(answer.stdout)
    except (OSError, subprocess.SubprocessError, ValueError):
        return None
    return Python(**{**facts, "executable": Path(facts["executable"]), "version": tuple(facts["version"])})


def find_python(wanted: str, *, with_rclpy: bool = False, variables: Mapping[str, str] | None = None) -> Python:
    """Choose the interpreter for the environment: the requested one, else the first that is supported.

    Args:
        wanted: the user's choice, "" for none.
        with_rclpy: accept only one that finds rclpy, for a sourced ROS.
        variables: as `describe` takes them.

    Raises:
        SetupError: there is none.
    """
    system = ["/usr/bin/python3", *(f"python{major}.{minor}" for major, minor in PYTHON_VERSIONS)]
    refused: list[str] = []
    for command in [wanted] if wanted else [sys.executable, "python3", *system]:
        python = describe(command, variables)
        if python is None:
            continue
        if python.fits and (python.has_rclpy or not with_rclpy):
            return python
        refused.append(".".join(map(str, python.version)))
    others = f"found {', '.join(sorted(set(refused)))}" if refused else "found none"
    if with_rclpy:
        raise SetupError(
            f"ROS 2 Jazzy is sourced, but no Python 3.11 or 3.12 imports its rclpy ({others}): "
            "apt-get install -y ros-jazzy-rclpy, or open a shell without it"
        )
    raise SetupError(
        f"Python 3.11 or 3.12 is needed, {others}: apt-get install -y python3 python3-dev python3-venv "
        "on Debian 12 or Ubuntu 24.04, or name one with PYTHON=/path/to/python3.12"
    )


def find_needs(python: Python, which: Callable[[str], str | None] = shutil.which) -> list[Need]:
    """List everything that the system lacks for an interpreter; `which` finds a program by its name."""
    series = debian_series(python)
    checks = (
        (any(which(name) for name in ("c++", "g++", "clang++")), Need("a C++ compiler", "g++")),
        (any(which(name) for name in ("cc", "gcc", "clang")), Need("a C compiler", "gcc")),
        (python.has_headers, Need("Python's headers (Python.h)", f"{series}-dev")),
        (python.has_venv, Need("Python's venv module", f"{series}-venv")),
    )
    return [need for there, need in checks if not there]


def find_renderer_needs(
    load: Callable[[str], object] = ctypes.CDLL, folders: Iterable[Path] = _DRIVER_FOLDERS
) -> list[Need]:
    """List what the system lacks to render without a display, as only the simulator `panda` does.

    Args:
        load: loads a shared library, or raises an OSError.
        folders: where Mesa's drivers may be.
    """
    needs = []
    for library, need in (
        ("libEGL.so.1", Need("EGL", "libegl1")),
        ("libEGL_mesa.so.0", Need("Mesa's EGL", "libegl-mesa0")),
    ):
        try:
            load(library)
        except OSError:
            needs.append(need)
    if not any(next(folder.glob("*swrast_dri.so"), None) for folder in folders):
        needs.append(Need("Mesa's software renderer", "libgl1-mesa-dri"))
    return needs


def debian_series(python: Python) -> str:
    """Name the prefix of an interpreter's Debian packages: `python3`, or `python3.12` if it is not the system's."""
    default = describe("/usr/bin/python3")
    if default is not None and default.version[:2] != python.version[:2]:
        return f"python{python.version[0]}.{python.version[1]}"
    return "python3"


def apt_command(needs: Iterable[Need]) -> list[str]:
    """Build the command that installs what is missing."""
    return ["apt-get", "install", "-y", *(need.package for need in needs)]


def may_install() -> bool:
    """Whether this process may install packages of Debian."""
    return os.geteuid() == 0 and shutil.which("apt-get") is not None


def missing_line(needs: Sequence[Need]) -> str:
    """Describe in one line what is missing, with the command to type."""
    prefix = "" if os.geteuid() == 0 else "sudo "
    return f"missing: {', '.join(need.what for need in needs)}. Type: {prefix}{' '.join(apt_command(needs))}"


def check_platform() -> None:
    """Refuse a machine for which there are no wheels.

    Raises:
        SetupError: the machine is not Linux on x86-64.
    """
    if platform.system() != "Linux" or platform.machine() != "x86_64":
        raise SetupError(
            f"the wheels are for Linux on x86-64, this is {platform.system()} on {platform.machine()}: "
            "use a container or a virtual machine of that kind"
        )
