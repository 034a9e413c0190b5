# SPDX-License-Identifier: Apache-2.0
"""Where shared files are, how extras are added, and which library versions are installed."""

from __future__ import annotations

import os
import platform
import re
import shlex
from collections.abc import Mapping
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path

WHEEL = "digital-siblings"
"""Distribution with all packages that need no ROS."""


def share_folders(package: str) -> list[Path]:
    """Folders in which the shared files of a ROS package may be, such as its messages, the first ones first."""
    prefixes = [Path(prefix) for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if prefix]
    shares = [prefix / "share" / package for prefix in [*prefixes, Path(__file__).parent]]
    return [*shares, Path(__file__).parents[2] / package]  # a checkout whose workspace is not built yet


def missing_of_ros() -> list[str]:
    """What nodes need and is not there of ROS 2 and the messages of a built checkout; empty where ROS is set up."""
    return [name for name in ("rclpy", "ds_interfaces") if find_spec(name) is None]


def wheel_version() -> str | None:
    """Version of the installed wheel; None in a checkout or a workspace."""
    return _version(WHEEL)


def _version(distribution: str) -> str | None:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return None


def ds_command(*words: object) -> str:
    """A command that can be typed where `ds` was started, with names of files quoted."""
    return shlex.join([os.environ.get("DS_COMMAND", "ds"), *map(str, words)])


def as_typed(commands: str) -> str:
    """Commands of a page, which begin with `ds`, as they are typed where `ds` was started."""
    return re.sub(r"(^|&& )ds ", lambda match: f"{match[1]}{ds_command()} ", commands)


_LEFT_OUT = ("dask", "gym")
"""Extras that a checkout's set-up leaves out, each a file in `requirements/`."""


def install_command(extra: str) -> str:
    """Command that installs the libraries of an extra of the wheel."""
    if wheel_version() is not None:
        return f"python -m pip install '{WHEEL}[{extra}]'"
    if extra in _LEFT_OUT:
        return f".venv/bin/python -m pip install --no-deps -r requirements/{extra}.txt"
    return "make setup"


EXTRAS = {
    **dict.fromkeys(("pandas", "pyarrow", "sklearn", "statsmodels"), "analysis"),
    **dict.fromkeys(("dask", "distributed"), "dask"),
    **dict.fromkeys(("backports", "lz4", "mcap", "rosbags"), "recording"),
    **dict.fromkeys(("panda3d", "vehiclemodels"), "panda"),
    "gymnasium": "gym",
    "openvino": "openvino",
    "pybullet": "bullet",
    "torch": "torch",
    "tornado": "watch",
}
"""Module -> the extra of the wheel that brings it."""


def missing_module(name: str) -> str:
    """Say in one line that a module, by the name in `ModuleNotFoundError`, is not installed, and what to type."""
    library = name.partition(".")[0]
    if library not in EXTRAS:
        return f"the Python package {library} is missing: ds doctor says how to install what is missing"
    return f"this needs {library}, which is not installed: {install_command(EXTRAS[library])}"


CPUINFO = Path("/proc/cpuinfo")
"""Where Linux describes the processors."""


def processor_flags(cpuinfo: Path = CPUINFO) -> frozenset[str]:
    """Features of this machine's first processor in Linux's words (`avx2`, `avx512_bf16`); empty if it states none."""
    try:
        lines = cpuinfo.read_text("utf-8", "replace").splitlines()
    except OSError:
        return frozenset()
    for line in lines:
        name, _, value = line.partition(":")
        if name.strip() in ("flags", "Features"):
            return frozenset(value.split())
    return frozenset()


_DISTRIBUTIONS = (
    "numpy", "scipy", "scikit-learn", "statsmodels", "opencv-python-headless", "torch", "onnxruntime", "openvino",
    "pybullet", "pymunk", "panda3d", "numba", "commonroad-vehicle-models", "shapely", "plotly",
)  # fmt: skip


@lru_cache(maxsize=1)  # each look-up parses a distribution's metadata
def versions() -> Mapping[str, str]:
    """Versions of Python and of the libraries that results depend on, by name, and the machine type."""
    libraries = {name: _version(name) or "not installed" for name in _DISTRIBUTIONS}
    return {"python": platform.python_version(), "machine": platform.machine(), **libraries}
