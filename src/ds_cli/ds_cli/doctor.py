# SPDX-License-Identifier: Apache-2.0
"""Checks the installation, and prints the command that fixes each problem. It changes nothing.

Standard library only, so that it runs before anything is installed: `python3 -m ds_cli.doctor`. By default
libraries are looked up, not imported, which takes a tenth of a second instead of ten; `--imports` imports them.
"""

from __future__ import annotations

import ctypes
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path
from typing import Any, NamedTuple

WHEEL = "digital-siblings"
"""Name of the wheel that holds all packages."""
SUPPORTED_PYTHONS = ((3, 11), (3, 12))
"""Versions for which the pinned requirements exist."""
SMALLEST_WEIGHTS = 2**20
"""Bytes; a smaller weights file is truncated, or a pointer to one (chosen: Dave-2 as float16 has 5.8 MB)."""

_SET_UP = "make setup"
_INSTALL = f"rm -rf .venv/.setup && {_SET_UP}"
"""Without its stamps set-up runs every step again, and pip installs what is missing or has another version."""
_RENDERER = "apt-get install -y libegl1 libegl-mesa0 libgl1-mesa-dri"
_MODULES = {
    "commonroad-vehicle-models": "vehiclemodels",
    "digital-siblings-networks": "ds_driver",
    "opencv-python-headless": "cv2",
    "pyyaml": "yaml",
    "scikit-learn": "sklearn",
}
"""Distributions whose module has another name; a test compares them with the installed metadata."""
IMPORT_TIME = 120.0
"""Seconds that all imports together may take; chosen: ten times what they take on a busy laptop."""
_LOOK_UP = """
import importlib, importlib.metadata as metadata, importlib.util, json, sys
really = len(sys.argv) > 2
found = {}
for distribution, module in json.loads(sys.argv[1]).items():
    try:
        if really:
            importlib.import_module(module)
        elif importlib.util.find_spec(module.partition(".")[0]) is None:
            raise ImportError(f"no module {module}")
        found[distribution] = [metadata.version(distribution), ""]
    except metadata.PackageNotFoundError:
        found[distribution] = ["", f"no metadata of {distribution}: it is installed in part"]
    except Exception as error:
        found[distribution] = ["", (str(error) or repr(error)).splitlines()[0]]
print()
print(json.dumps(found))
"""
_PARTS = """
import importlib.metadata as metadata, json
listed = []
for group in ("simulators", "drivers", "features", "operators"):
    for entry in metadata.entry_points(group="digital_siblings." + group):
        try:
            part = entry.load()
            problem = part.missing() if group == "simulators" else ""
        except Exception as error:
            problem = (str(error) or repr(error)).splitlines()[0]
        listed.append([group[:-1], entry.name, entry.dist.name + " " + entry.dist.version, problem])
print()
print(json.dumps(listed))
"""


class Check(NamedTuple):
    """Result of one check: what was found, in one line, and the command that fixes it, "" if there is none."""

    name: str
    ok: bool
    detail: str
    fix: str


def diagnose(root: Path | None = None, *, imports: bool = False) -> list[Check]:
    """Check everything in a repository, in the order in which problems would be fixed; import libraries if asked."""
    root = root or repository()
    if not (root / "requirements/project.txt").is_file() and (of_wheel := diagnose_wheel(imports=imports)) is not None:
        return of_wheel
    python = root / ".venv/bin/python"
    checks = check_system()
    if not python.is_file():
        return [*checks, Check("environment", False, ".venv is not there yet", _SET_UP)]
    pins = read_pins(root / "requirements/project.txt")
    sourced = root / ".venv/.setup/ros-prefix"
    if sourced.is_file() and sourced.read_text():
        del pins["numpy"]  # an installed ROS 2 brings the NumPy that its modules were built for
    modules = {name: module_of(name) for name in pins}
    dask = "distributed"
    wanted = {**modules, "rclpy": "rclpy", "ds-interfaces": "ds_interfaces.msg", dask: dask}
    places = look_up(python, wanted, imports=imports)
    file = "requirements/dask.txt"
    install, pinned = f".venv/bin/python -m pip install --no-deps -r {file}", read_pins(root / file)[dask]
    return [
        *checks,
        Check("environment", True, str(python.parent.parent), ""),
        *check_ros(root, places),
        *(check_library(name, places[name], _INSTALL, pinned=version) for name, version in pins.items()),
        check_library(dask, places[dask], install, pinned=pinned, absent=", for --engine dask"),
        check_renderer(),
        *check_parts(python),
        check_weights(root / "src/ds_driver/ds_driver/models/dave2.safetensors"),
    ]


def diagnose_wheel(*, imports: bool = False) -> list[Check] | None:
    """Check the libraries that the wheel asks for, extras and ROS being optional; None if no wheel is installed."""
    try:
        wanted = requires(WHEEL) or []
    except PackageNotFoundError:
        return None
    extras: dict[str, str] = {}
    needed = []
    for requirement in wanted:
        name = re.split(r"[^\w.-]", requirement, maxsplit=1)[0].lower()
        extra = re.search(r"extra == ['\"](\w+)['\"]", requirement)
        if extra is None:
            needed.append(name)
        elif extra[1] != "default":  # which is the sum of others
            extras[name] = extra[1]
    modules = {name: module_of(name).replace("-", "_") for name in [*needed, *extras]}
    places = look_up(Path(sys.executable), {**modules, "rclpy": "rclpy"}, imports=imports)
    series = ".".join(map(str, sys.version_info[:2]))
    checks = [
        _check("Python", sys.version_info >= (3, 11), series, f"{series}: 3.11 or later is needed", _apt("python3"))
    ]
    checks += [check_library(name, places[name], f"python -m pip install {WHEEL}") for name in needed]
    installs = {name: f": python -m pip install '{WHEEL}[{group}]'" for name, group in extras.items()}
    checks += [check_library(name, places[name], "", absent=absent) for name, absent in installs.items()]
    version, problem = places["rclpy"]
    nodes = ": nodes need ROS 2 and a built checkout (make setup)"
    checks.append(check_library("ROS 2", (version and f"rclpy {version}", problem), "", absent=nodes))
    weights = check_weights(Path(__file__).parents[1] / "ds_driver/models/dave2.safetensors")
    if weights.fix:
        weights = weights._replace(fix="python -m pip install --force-reinstall --no-deps WHEEL.whl")
    return [*checks, check_renderer(), *check_parts(Path(sys.executable)), weights]


def module_of(distribution: str) -> str:
    """Name of a distribution's module."""
    return _MODULES.get(distribution, distribution)


def repository() -> Path:
    """The repository that this file belongs to, also if the package is a link to it."""
    for folder in Path(__file__).resolve().parents:
        if (folder / "requirements/project.txt").is_file():
            return folder
    return Path(os.environ.get("DS_ROOT", Path.cwd()))


def check_system(
    version: tuple[int, int] = sys.version_info[:2], which: Callable[[str], str | None] = shutil.which
) -> list[Check]:
    """Check what must come from the operating system."""
    series = "python3" if Path("/usr/bin/python3").exists() else f"python{version[0]}.{version[1]}"
    compiler = next((path for name in ("c++", "g++", "clang++") if (path := which(name))), None)
    header = Path(sysconfig.get_paths()["include"]) / "Python.h"
    has_venv = importlib.util.find_spec("ensurepip") is not None
    shown = ".".join(map(str, version))
    return [
        _check("Python", version in SUPPORTED_PYTHONS, shown, f"{shown}: 3.11 or 3.12 is needed", _apt("python3")),
        _check("C++ compiler", compiler is not None, compiler or "", "none found", _apt("g++")),
        _check("Python headers", header.is_file(), str(header), f"{header} is missing", _apt(f"{series}-dev")),
        _check("venv module", has_venv, "there", "ensurepip is missing", _apt(f"{series}-venv")),
    ]


def check_ros(root: Path, modules: Mapping[str, tuple[str, str]]) -> list[Check]:
    """Check ROS and the workspace, given what `look_up` found, with `rclpy` and `ds-interfaces` in it."""
    version, problem = modules["rclpy"]
    own_interfaces, reason = modules["ds-interfaces"]
    built = (root / "ros_ws/install/setup.bash").is_file()
    advice = f"{_SET_UP}; then use ./ds, or: source ros_ws/install/setup.bash"
    return [
        _check("ROS 2", not problem, f"rclpy {version}", problem, advice),
        _check("workspace", built and not reason, own_interfaces or "built", reason or "not built", advice),
    ]


def check_library(name: str, place: tuple[str, str], fix: str, *, pinned: str = "", absent: str = "") -> Check:
    """Check that a library is there, given what `look_up` found, and has its pinned version, if any.

    An optional one may be missing: `absent` says what for.
    """
    version, problem = place
    if not problem and pinned and re.split("[+-]", version)[0] != pinned:
        problem = f"{version} is installed, {pinned} is pinned"
    elif problem and absent:
        version, problem = f"not installed; optional{absent}", ""
    return _check(f"{name} (optional)" if absent else name, not problem, version, problem, fix)


def check_renderer(load: Callable[[str], object] = ctypes.CDLL) -> Check:
    """Check for the libraries with which some simulators render; everything else works without them."""
    try:
        for library in ("libEGL.so.1", "libEGL_mesa.so.0"):
            load(library)
    except OSError as error:
        detail = f"{' '.join(str(error).split())}; optional, for simulators that render with Mesa: {_RENDERER}"
        return Check("renderer (optional)", True, detail, "")
    return Check("renderer (optional)", True, "Mesa's EGL", "")


def check_parts(python: Path) -> list[Check]:
    """List the parts that installed packages add, and check that each can be imported and has what it needs."""
    listed, failure = _answer(python, _PARTS)
    if failure:
        return [Check("installed parts", False, failure, _SET_UP)]
    return [
        Check(f"{group} {name}", not problem, f"of {package}" + (f": {problem}" if problem else ""), "")
        for group, name, package, problem in listed
    ]


def check_weights(file: Path) -> Check:
    """Check that the shipped network is there, and complete as far as its size tells."""
    size = file.stat().st_size if file.is_file() else 0
    file_and_size = f"{file.name}, {size / 2**20:.1f} MB"
    problem = f"{file_and_size}: truncated, or not fetched" if size else f"{file.name} is missing"
    fix = "git checkout -- src/ds_driver, or ./ds train"
    return _check("network weights", size >= SMALLEST_WEIGHTS, file_and_size, problem, fix)


def read_pins(requirements: Path) -> dict[str, str]:
    """Read distribution (lower case) and version of the direct requirements: the part above the dependencies."""
    pins = {}
    for line in requirements.read_text().splitlines():
        if line.startswith("# their dependencies"):
            break
        name, separator, version = line.partition("#")[0].strip().partition("==")
        if separator:
            pins[name.lower()] = version
    return pins


def look_up(python: Path, modules: Mapping[str, str], *, imports: bool = False) -> dict[str, tuple[str, str]]:
    """Look up libraries in a process of its own: its interpreter may be another one, and some libraries print.

    Of each distribution, given with the name of its module, returns its version and "", or "" and why it is unusable.
    """
    answer, failure = _answer(python, _LOOK_UP, json.dumps(dict(modules)), *(["imports"] if imports else []))
    if failure:
        return dict.fromkeys(modules, ("", failure))
    return {name: (version, problem) for name, (version, problem) in answer.items()}


def _answer(python: Path, script: str, *arguments: str) -> tuple[Any, str]:
    """Run a script in an interpreter; the last line that it prints, parsed as JSON, or why there is none."""
    try:
        done = subprocess.run(
            [str(python), "-c", script, *arguments], capture_output=True, text=True, check=False, timeout=IMPORT_TIME
        )
    except subprocess.TimeoutExpired:
        return None, f"the interpreter was still importing after {IMPORT_TIME:g} s"
    except OSError as error:
        return None, f"the interpreter does not start: {error.strerror}"
    try:
        return json.loads(done.stdout.splitlines()[-1]), ""
    except (IndexError, ValueError):
        return None, f"the interpreter ended with status {done.returncode} while importing"


def show(checks: Sequence[Check]) -> None:
    """Print one line per check, and below a failed one what fixes it."""
    colour = sys.stdout.isatty() and "NO_COLOR" not in os.environ
    width = max(len(check.name) for check in checks)
    for check in checks:
        state = "ok    " if check.ok else "FAILED"
        if colour:
            state = f"\033[{32 if check.ok else 31}m{state}\033[0m"
        print(f"{state}  {check.name:<{width}}  {check.detail}".rstrip())
        if check.fix:
            print(f"{'':8}{'':<{width}}  type: {check.fix}")
    failed = sum(not check.ok for check in checks)
    print(f"{failed} of {len(checks)} checks failed" if failed else f"all {len(checks)} checks passed")


_HELP = """\
Usage: ds doctor [--imports] [--json]

Check the installation and print the command that fixes each problem. Changes nothing.

  --imports   Import every library instead of looking it up; takes some ten seconds.
  --json      Print one JSON document.

Exit status: 0 all is well, 1 something is missing."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Check, print a table or one JSON document, and return the exit status; see `_HELP`, or 2: unknown argument."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    if any(argument in ("-h", "--help") for argument in words):
        print(_HELP)
        return 0
    unknown = [argument for argument in words if argument not in ("--json", "--imports")]
    if unknown:
        print(f"error: ds doctor: unknown argument {unknown[0]}; see ds doctor --help", file=sys.stderr)
        return 2
    checks = diagnose(imports="--imports" in words)
    healthy = all(check.ok for check in checks)
    if "--json" in words:
        print(json.dumps({"ok": healthy, "checks": [check._asdict() for check in checks]}, indent=2))
    else:
        show(checks)
    print(f"next: {os.environ.get('DS_COMMAND', 'ds')} {'demo' if healthy else 'doctor'}", file=sys.stderr)
    return 0 if healthy else 1


def _check(name: str, ok: bool, state: str, problem: str, fix: str) -> Check:
    return Check(name, ok, state if ok else problem, "" if ok else fix)


def _apt(package: str) -> str:
    return f"{'' if os.geteuid() == 0 else 'sudo '}apt-get install -y {package}"


if __name__ == "__main__":
    sys.exit(main())
