# SPDX-License-Identifier: Apache-2.0
"""Colcon workspace: packages that must be rebuilt, and their environment as a flat file."""

from __future__ import annotations

import os
import shlex
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path

from setup_tool import ros
from setup_tool.stamps import digest

_BASE_PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
_PATH_LISTS = (
    *("AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH", "COLCON_PREFIX_PATH"),
    *("LD_LIBRARY_PATH", "PATH", "PYTHONPATH"),
)
_DISCOVERY_HOOK = "ds_bringup/share/ds_bringup/environment/one_machine.sh"
"""Set-up file of ds_bringup that selects the discovery profile, below the workspace's install folder."""
_STANDARD = ("simulation_interfaces",)
"""Packages of which this workspace has the part that it uses; an installed one is whole, and preferred."""
_CHOSEN_BY_HOOK = ("FASTRTPS_DEFAULT_PROFILES_FILE", "ROS_AUTOMATIC_DISCOVERY_RANGE")


def packages(source: Path, prefix: Path | None = None) -> dict[str, str]:
    """Map package -> hash of the files whose change requires a rebuild.

    Python modules are linked, not copied, and need no rebuild.

    Args:
        source: folder of the packages.
        prefix: folder of the installed ROS 2 below the workspace; None for wheels, which have no standard packages.
    """
    folders = [manifest.parent for manifest in sorted(source.glob("*/package.xml"))]
    return {folder.name: digest(_inputs(folder)) for folder in folders if not _is_installed(folder.name, prefix)}


def remove_build(workspace: Path, package: str) -> None:
    """Delete everything that a package's build has created."""
    for folder in ("build", "install"):
        shutil.rmtree(workspace / folder / package, ignore_errors=True)


def built_packages(workspace: Path) -> set[str]:
    """List the packages with files in the install folder."""
    return {folder.name for folder in (workspace / "install").glob("*/") if not folder.name.startswith(".")}


def write_environment_file(environment: Path, workspace: Path, *, has_wheels: bool) -> None:
    """Write the built workspace's environment as plain exports, which shells read fast, to `env.sh`.

    Args:
        environment: root of the virtual environment.
        workspace: built colcon workspace, in the root of the project.
        has_wheels: ROS comes from wheels in the virtual environment.
    """
    install, target = workspace / "install", environment / "env.sh"
    sourced = ros.environment_after(install / "setup.bash", {"PATH": _BASE_PATH, "HOME": os.environ.get("HOME", "/")})
    if has_wheels:
        folders = [environment / "lib", *sorted(environment.glob("lib/python3.*/site-packages/ros_*.libs"))]
        libraries = [str(folder) for folder in folders]
        present = sourced.get("LD_LIBRARY_PATH", "").split(os.pathsep)
        sourced["LD_LIBRARY_PATH"] = os.pathsep.join([p for p in present if p and p not in libraries] + libraries)
        sourced[ros.BOOTSTRAP_DONE] = "1"
    lines = [
        "# Written by tools/setup.py. The variables that `source ros_ws/install/setup.bash` sets.",
        f"export DS_ROOT={shlex.quote(str(workspace.parent))}",
        *_exports(sourced),
        f". {shlex.quote(str(install / _DISCOVERY_HOOK))}",
    ]
    new = target.with_suffix(".new")
    new.write_text("\n".join(lines) + "\n")
    os.replace(new, target)


def _is_installed(package: str, prefix: Path | None) -> bool:
    index = "share/ament_index/resource_index/packages"
    return prefix is not None and package in _STANDARD and (prefix / index / package).is_file()


def _exports(variables: Mapping[str, str]) -> Iterator[str]:
    for name, value in sorted(variables.items()):
        if name in ("HOME", "PWD", "OLDPWD", "SHLVL", *_CHOSEN_BY_HOOK):
            continue
        if name in _PATH_LISTS:
            ours = os.pathsep.join(p for p in value.split(os.pathsep) if p and p not in _BASE_PATH.split(os.pathsep))
            yield f'export {name}={shlex.quote(ours)}"${{{name}:+:${name}}}"'
        else:
            yield f"export {name}={shlex.quote(value)}"


def _inputs(package: Path) -> Iterator[Path | str]:
    for file in sorted(package.rglob("*")):
        inside = file.relative_to(package)
        top = inside.parts[0]
        if not file.is_file() or top in (package.name, "test") or file.suffix in (".md", ".pyc"):
            continue
        yield str(inside)
        yield file
