# SPDX-License-Identifier: Apache-2.0
"""Starts the processes of a graph, watches them, restarts dead ones, and leaves none behind."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from ds_base.errors import RunError
from ds_base.folder_files import enter_folder
from ds_base.installation import missing_of_ros
from ds_base.processes import USER_DOMAIN, ChildProcesses, last_line_of
from ds_driver.networks.driver_name import AUTOPILOT, DriverName
from ds_sim.registry import SimulatorName

MEMORY = Path("/dev/shm")
"""Where ROS's tracing takes a page while it is imported; without room there, the process dies by SIGBUS."""


class RosMissingError(RunError):
    """ROS, or the workspace's messages, are not installed, or cannot be imported."""


def check_ros() -> None:
    """Check that ROS and the workspace's messages can be imported, or raise `RosMissingError`."""
    if MEMORY.is_dir() and (space := os.statvfs(MEMORY)).f_blocks and not space.f_bavail:  # without limit: no blocks
        raise RosMissingError(f"{MEMORY} is full, and ROS needs a page of it: make room, or use --engine local")
    if missing := missing_of_ros():
        raise RosMissingError(
            f"{' and '.join(missing)} not found: nodes need ROS 2 and a built checkout (make setup); leave out "
            "--attach and --engine graph to drive without them"
        )


STOP_TIME = 3.0
"""Limit for a process to obey SIGINT, then SIGTERM, before it is killed, s."""


class ProcessError(RunError):
    """Process that ended unexpectedly."""


@dataclass(frozen=True, kw_only=True)
class ProcessSpec:
    """Process with a node or two."""

    name: str  # name in messages, and of the log
    module: str  # Python module to run
    arguments: tuple[str, ...] = ()  # of the command line, before those of ROS
    namespace: str = "/"
    parameters: dict[str, object]  # ROS parameters
    remappings: dict[str, str] = field(default_factory=dict)  # topic or service -> name in the graph

    def command(self) -> list[str]:
        """Build the command line."""
        arguments = [sys.executable, "-m", self.module, *self.arguments]
        arguments += ["--ros-args", "-r", f"__ns:={self.namespace}"]
        for name, other in self.remappings.items():
            arguments += ["-r", f"{name}:={other}"]
        for key, value in self.parameters.items():
            arguments += ["-p", f"{key}:={json.dumps(value, ensure_ascii=False)}"]
        return arguments


class Supervisor:
    """Runs processes in a ROS domain until it is closed, each with a log in a folder, created if missing."""

    def __init__(self, specs: Sequence[ProcessSpec], *, domain: int, logs: Path) -> None:
        enter_folder(logs)
        self._specs = {spec.name: spec for spec in specs}
        self._logs = logs
        self._environment = os.environ | {
            "ROS_DOMAIN_ID": str(domain),
            USER_DOMAIN: os.environ.get(USER_DOMAIN) or os.environ.get("ROS_DOMAIN_ID") or "0",
            "OMP_NUM_THREADS": "1",
            "PYTHONUNBUFFERED": "1",
            "RCUTILS_COLORIZED_OUTPUT": "0",
        }
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._children = ChildProcesses()
        for name in self._specs:
            self._start(name)

    def names_in(self, namespace: str) -> set[str]:
        """Names of the processes with nodes in a namespace."""
        return {name for name, spec in self._specs.items() if spec.namespace == namespace}

    def dead(self) -> list[str]:
        """Names of processes that ended."""
        return [name for name, process in self._processes.items() if process.poll() is not None]

    def check(self, names: Collection[str]) -> None:
        """Check that none of these processes has ended; else, a ProcessError has the last line of its log."""
        for name in set(self.dead()) & set(names):
            status = self._processes[name].returncode
            if status == -signal.SIGKILL:
                raise ProcessError(f"{name} was killed before it was ready: give the same command again")
            raise ProcessError(f"{name} ended with status {status}: {last_line_of(self._log(name))}")

    def revive(self) -> list[str]:
        """Restart every dead process, and return their names."""
        for name in (names := self.dead()):
            self._start(name)
        return names

    def restart(self, name: str) -> None:
        """Kill a process that no longer answers, and restart it."""
        process = self._processes[name]
        process.kill()
        process.wait()
        self._start(name)

    def close(self) -> None:
        """Stop every process: SIGINT, then SIGTERM, then SIGKILL."""
        for stop in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            running = [p for p in self._processes.values() if p.poll() is None]
            for process in running:
                process.send_signal(stop)
            deadline = time.monotonic() + STOP_TIME
            for process in running:
                try:
                    process.wait(max(0.0, deadline - time.monotonic()))
                except subprocess.TimeoutExpired:
                    continue
        self._children.close()

    def _log(self, name: str) -> Path:
        return self._logs / f"{name}.log"

    def _start(self, name: str) -> None:
        command, log = self._specs[name].command(), self._log(name)
        self._processes[name] = self._children.start(command, environment=self._environment, log=log)


def closed_loop_processes(
    driver: DriverName, namespaces: dict[SimulatorName, str], command_timeout: float, *, draw: str = "all"
) -> list[ProcessSpec]:
    """Specify one process per simulator, with a driver's node beside the simulator's; see `running_graph`."""
    return [
        ProcessSpec(
            name=f"closed_loop_{namespace.strip('/').replace('/', '_')}",
            module="ds_driver.ros.closed_loop_node",
            arguments=("autopilot",) if driver == AUTOPILOT else ("driver",),
            namespace=namespace,
            parameters={"simulator": name, "command_timeout": command_timeout, "draw": draw}
            | ({} if driver == AUTOPILOT else {"network": str(driver)}),
        )
        for name, namespace in namespaces.items()
    ]
