# SPDX-License-Identifier: Apache-2.0
"""Colcon workspace: built as `colcon build` would, without its seconds per package, and its environment as a flat file.

Python packages are linked: their folders are on PYTHONPATH, and only executables and entries of ament's index are
written. What has a CMakeLists.txt is built by CMake.
"""

from __future__ import annotations

import os
import shlex
import shutil
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from configparser import ConfigParser
from pathlib import Path

from setup_tool.console import Console
from setup_tool.stamps import digest

BASE = {"PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin", "HOME": os.environ.get("HOME", "/")}
"""Variables of a shell that has sourced nothing."""
BUILD_JOBS = 2
"""Parallel packages, and parallel compilers of each; chosen: generated C++ takes up to 1 GB of memory."""
_BUILD_PATH = Path(__file__).with_name("build_path")
_INDEX = "share/ament_index/resource_index/packages"
_DISCOVERY_HOOK = "ds_bringup/share/ds_bringup/environment/one_machine.sh"
"""Set-up file of ds_bringup that selects the discovery profile, below the workspace's install folder."""
_STANDARD = ("simulation_interfaces", "tf2_msgs")
"""Packages of which this workspace has the part that it uses; an installed one is whole, and preferred."""
_PATH_LISTS = ("AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH", "LD_LIBRARY_PATH", "PYTHONPATH", "PATH")
_EXECUTABLE = """#!{python}
import sys

from {module} import {function}

sys.exit({function}())
"""


def packages(source: Path, prefix: Path | None = None) -> dict[str, Path]:
    """Map package -> its folder, for what is to be built.

    Args:
        source: folder of the packages.
        prefix: folder of the installed ROS 2 below the workspace; None for wheels, which have no standard packages.
    """
    folders = [manifest.parent for manifest in sorted(source.glob("*/package.xml"))]
    return {folder.name: folder for folder in folders if not _is_installed(folder.name, prefix)}


def inputs(source: Path, prefix: Path | None = None) -> str:
    """Hash the files whose change requires a rebuild: all but Python modules, which are linked, and tests and texts."""
    return digest(part for folder in packages(source, prefix).values() for part in _inputs(folder))


def build(
    workspace: Path, source: Path, prefix: Path | None, python: Path, variables: Mapping[str, str], console: Console
) -> None:
    """Build all packages into the workspace's install folder; what CMake has built before is used again.

    Args:
        workspace: receives the folders `build` and `install`.
        source: folder of the packages.
        prefix: folder of the installed ROS 2; None for wheels, which can use no C++ code: it is not generated.
        python: interpreter of the virtual environment.
        variables: environment with the ROS below the workspace.
        console: runs CMake.
    """
    shutil.rmtree(workspace / "install", ignore_errors=True)
    for folder in (workspace / "build/parsed", workspace / "install"):
        folder.mkdir(parents=True, exist_ok=True)
        (workspace / folder.relative_to(workspace).parts[0] / "COLCON_IGNORE").touch()
    environment = {
        **variables,
        "DS_PARSED": str(workspace / "build/parsed"),
        "PATH": os.pathsep.join([str(python.parent), variables["PATH"]]),
        "PYTHONPATH": os.pathsep.join(filter(None, [str(_BUILD_PATH), variables.get("PYTHONPATH")])),
        "VIRTUAL_ENV": str(python.parent.parent),
    }

    def run_cmake(package: Path) -> None:
        target = workspace / "build" / package.name
        target.mkdir(parents=True, exist_ok=True)
        advice = "the compiler's message is in the log"
        configure: list[str | Path] = [
            *("-S", package, "-B", target, "-GNinja", "-DBUILD_TESTING=OFF", f"-DPython3_EXECUTABLE={python}"),
            f"-DCMAKE_INSTALL_PREFIX={workspace / 'install' / package.name}",
            f"-DWITHOUT_CPP={'OFF' if prefix else 'ON'}",
        ]
        steps: list[list[str | Path]] = [
            configure,
            ["--build", target, "--parallel", str(BUILD_JOBS)],
            ["--install", target],
        ]
        for arguments in steps:
            # ament's installation writes its manifest into the working directory.
            console.run(["cmake", *arguments], environment=environment, folder=target, advice=advice)

    folders = packages(source, prefix).values()
    with ThreadPoolExecutor(BUILD_JOBS) as pool:
        for _ in pool.map(run_cmake, [folder for folder in folders if _has_cmake(folder)]):
            pass
    for folder in folders:
        if not _has_cmake(folder):
            _link(folder, workspace / "install" / folder.name, python)


def products(workspace: Path, source: Path, prefix: Path | None = None) -> list[Path]:
    """List the files without which the built workspace does not work."""
    made = []
    for name, folder in packages(source, prefix).items():
        made += [workspace / "install" / name / _INDEX / name, workspace / "install" / name / "share" / name]
        manifest = workspace / "build" / name / "install_manifest.txt"
        if _has_cmake(folder):
            made += map(Path, manifest.read_text().splitlines()) if manifest.is_file() else [manifest]
        else:
            made += [workspace / "install" / name / "lib" / name / program for program in _executables(folder)]
    return made


def write_environment(environment: Path, workspace: Path, source: Path, variables: Mapping[str, str] | None) -> None:
    """Write what shells source, plain exports that are read fast, to `env.sh`.

    Args:
        environment: root of the virtual environment.
        workspace: colcon workspace, in the root of the project.
        source: folder of the packages.
        variables: `BASE` with the ROS below the built workspace; None if it is not built yet.
    """
    install, target = workspace / "install", environment / "env.sh"
    prefixes = sorted(p.parents[4] for p in install.glob(f"*/{_INDEX}/*")) if variables else []
    ours = {
        "AMENT_PREFIX_PATH": prefixes,
        "CMAKE_PREFIX_PATH": [p for p in prefixes if (p / "share" / p.name / "cmake").is_dir()],
        "LD_LIBRARY_PATH": [p / "lib" for p in prefixes if next(p.glob("lib/*.so"), None)],
        "PYTHONPATH": [
            *(p.parent for p in sorted(source.glob("*/setup.cfg"))),
            *(folder for p in prefixes for folder in p.glob("lib/python3.*/site-packages")),
        ],
        "PATH": [environment / "bin"],
    }
    lines = [
        "# Written by tools/setup.py: what `source ros_ws/install/setup.bash` sets.",
        f"export DS_ROOT={shlex.quote(str(workspace.parent))}",
        *_exports({name: list(map(str, paths)) for name, paths in ours.items()}, variables or {}),
    ]
    if variables:
        lines.append(f". {shlex.quote(str(install / _DISCOVERY_HOOK))}")
        (install / "setup.bash").write_text(f". {shlex.quote(str(target))}\n")
    new = target.with_suffix(".new")
    new.write_text("\n".join(lines) + "\n")
    os.replace(new, target)


def _is_installed(package: str, prefix: Path | None) -> bool:
    return prefix is not None and package in _STANDARD and (prefix / _INDEX / package).is_file()


def _has_cmake(package: Path) -> bool:
    return (package / "CMakeLists.txt").is_file()


def _executables(package: Path) -> dict[str, tuple[str, str]]:
    """Map executable -> module and function."""
    declared = ConfigParser(delimiters=["="])
    declared.read(package / "setup.cfg")
    lines = declared.get("options.entry_points", "console_scripts", fallback="").split("\n")
    pairs = (line.split("=") for line in lines if line.strip())
    return {name.strip(): (place.split(":")[0].strip(), place.split(":")[1].strip()) for name, place in pairs}


def _link(package: Path, prefix: Path, python: Path) -> None:
    """Write what `colcon build --symlink-install` writes for a Python package, but for its set-up files."""
    for folder in (_INDEX, f"share/{package.name}", f"lib/{package.name}"):
        (prefix / folder).mkdir(parents=True)
    (prefix / _INDEX / package.name).touch()
    (prefix / "share" / package.name / "package.xml").symlink_to(package / "package.xml")
    for name, (module, function) in _executables(package).items():
        program = prefix / "lib" / package.name / name
        program.write_text(_EXECUTABLE.format(python=python, module=module, function=function))
        program.chmod(0o755)


def _exports(ours: Mapping[str, list[str]], below: Mapping[str, str]) -> Iterator[str]:
    """Write exports: our paths, those of the ROS below, then those of the shell that reads them."""
    for name in _PATH_LISTS:
        added = [p for p in below.get(name, "").split(os.pathsep) if p and p not in BASE["PATH"].split(os.pathsep)]
        if paths := [*ours[name], *added]:
            yield f'export {name}={shlex.quote(os.pathsep.join(paths))}"${{{name}:+:${name}}}"'
    for name, value in sorted(below.items()):
        if name not in (*_PATH_LISTS, *BASE, "PWD", "OLDPWD", "SHLVL"):
            yield f"export {name}={shlex.quote(value)}"


def _inputs(package: Path) -> Iterator[Path | str]:
    for file in sorted(package.rglob("*")):
        inside = file.relative_to(package)
        top = inside.parts[0]
        if not file.is_file() or top in (package.name, "test") or file.suffix in (".md", ".pyc"):
            continue
        yield str(inside)
        yield file
