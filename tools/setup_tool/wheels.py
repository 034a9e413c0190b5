"""Turns a virtual environment with ROS wheels into a ROS prefix: this machine's CMake paths, and a setup.bash."""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Mapping
from pathlib import Path

from setup_tool.console import SetupError

_ASK = """
import json, os, sysconfig
import numpy
from ament_package.template import prefix_level
templates = os.path.dirname(prefix_level.__file__)
print(json.dumps([sysconfig.get_paths()["include"], numpy.get_include(), templates]))
"""
_BUILDER = r'/opt/python/[^/;"]+'
"""Path of Python on the machine that built the wheels, as in their exported CMake targets."""
_NUMPY_HEADERS = re.compile(_BUILDER + r"/lib/python[\d.]+/site-packages/numpy/_core/include")
_PYTHON_HEADERS = re.compile(_BUILDER + r"/include/python[\d.]+")
_TEMPLATES = (
    "_local_setup_util.py",
    "local_setup.bash",
    "local_setup.sh.in",
    "local_setup.zsh",
    "setup.bash",
    "setup.sh.in",
    "setup.zsh",
)


def prepare_prefix(environment: Path, variables: Mapping[str, str]) -> int:
    """Prepare a virtual environment to serve as a ROS prefix.

    Args:
        environment: root of the virtual environment, with the wheels installed.
        variables: environment variables, without those of another Python.

    Returns:
        Number of CMake files that were changed.

    Raises:
        SetupError: the wheels are not complete.
    """
    python = environment / "bin/python"
    try:
        answer = subprocess.run([python, "-c", _ASK], env=dict(variables), capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError) as error:
        reason = (getattr(error, "stderr", "") or str(error)).strip().splitlines()[-1]
        raise SetupError(f"the ROS wheels are not complete ({reason}): `make clean`, then again") from None
    python_headers, numpy_headers, templates = json.loads(answer.stdout)
    _write_setup_files(environment, Path(templates), python)
    exports = environment.glob("share/*/cmake/*Export.cmake")
    return sum(use_headers(export, python_headers, numpy_headers) for export in exports)


def use_headers(export: Path, python_headers: str, numpy_headers: str) -> bool:
    """Replace the builder's include folders in one exported CMake file; True if it had any."""
    text = export.read_text()
    fixed = _NUMPY_HEADERS.sub(lambda _: numpy_headers, text)
    fixed = _PYTHON_HEADERS.sub(lambda _: python_headers, fixed)
    if fixed != text:
        export.write_text(fixed)
    return fixed != text


def _write_setup_files(prefix: Path, templates: Path, python: Path) -> None:
    values = {
        "@CMAKE_INSTALL_PREFIX@": str(prefix),
        "@ament_package_PYTHON_EXECUTABLE@": str(python),
        "@SKIP_PARENT_PREFIX_PATH@": "TRUE",
    }
    for name in _TEMPLATES:
        text = (templates / name).read_text()
        for placeholder, value in values.items():
            text = text.replace(placeholder, value)
        (prefix / name.removesuffix(".in")).write_text(text)
