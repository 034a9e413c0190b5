# SPDX-License-Identifier: Apache-2.0
"""Starts schedulers and workers of Dask as users do, in processes of their own."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from ds_base.processes import python_environment

OWNER = "DS_TEST_CLUSTER"
"""Variable that marks the processes of a cluster as its own; other tests drive beside them."""


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


class DaskProcesses:
    """Scheduler and workers on loopback."""

    def __init__(self, folder: Path, tls: Sequence[str] = ()) -> None:
        self._folder, self._tls = folder, list(tls)
        self._processes: list[subprocess.Popen[bytes]] = []
        self.port = free_port()
        self.address = f"{'tls' if tls else 'tcp'}://127.0.0.1:{self.port}"
        self.start_scheduler()

    def start_scheduler(self) -> None:
        self.scheduler = self._start("scheduler", "--host", "127.0.0.1", "--port", str(self.port), "--no-dashboard")

    def worker(self, *arguments: str) -> subprocess.Popen[bytes]:
        """Start a worker, without a nanny, so that killing it ends it."""
        name = f"worker_{len(self._processes)}"
        options = ["--host", "127.0.0.1", "--nthreads", "1", "--no-nanny", "--no-dashboard", "--local-directory"]
        return self._start("worker", self.address, *options, str(self._folder / name), *arguments)

    def _start(self, kind: str, *arguments: str) -> subprocess.Popen[bytes]:
        log = self._folder / f"{kind}_{len(self._processes)}.log"
        with log.open("wb") as file:
            process = subprocess.Popen(
                [sys.executable, "-m", "dask", kind, *arguments, *self._tls],
                stdout=file,
                stderr=subprocess.STDOUT,
                env=python_environment() | {OWNER: str(self._folder)},
            )
        self._processes.append(process)
        return process

    def drive_workers(self) -> set[int]:
        """Process ids of what drives for this cluster; other tests' processes drive on the same machine."""
        mine = f"{OWNER}={self._folder}".encode()
        found = set()
        for process in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):  # it ended meanwhile
                drives = b"ds_driver.closed_loop.worker_process" in (process / "cmdline").read_bytes()
                if drives and mine in (process / "environ").read_bytes().split(b"\0"):
                    found.add(int(process.name))
        return found

    def close(self) -> None:
        for process in reversed(self._processes):
            process.send_signal(signal.SIGCONT)
            process.kill()
            process.wait()
