"""Starts child processes that never outlive this one, even if it is killed."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None)


class ChildProcesses:
    """Starts children from one lasting thread: the kernel ends a child when the thread that created it ends."""

    def __init__(self) -> None:
        self._spawner = ThreadPoolExecutor(1, thread_name_prefix="spawner")

    def start(
        self, command: Sequence[str], *, environment: Mapping[str, str], log: Path, pass_fds: Sequence[int] = ()
    ) -> subprocess.Popen[bytes]:
        """Start a child in a session of its own, so that Ctrl-C in the terminal reaches only this process.

        Args:
            command: program and arguments.
            environment: its whole environment.
            log: file to which its standard output and standard error are appended.
            pass_fds: file descriptors that it inherits.
        """

        def spawn() -> subprocess.Popen[bytes]:
            with log.open("ab") as file:
                return subprocess.Popen(
                    command,
                    stdin=subprocess.DEVNULL,
                    stdout=file,
                    stderr=subprocess.STDOUT,
                    env=environment,
                    start_new_session=True,
                    pass_fds=pass_fds,
                    preexec_fn=partial(_die_with_parent, os.getpid()),
                )

        return self._spawner.submit(spawn).result()

    def close(self) -> None:
        """End the thread, and with it every child that still runs."""
        self._spawner.shutdown()


def python_environment() -> dict[str, str]:
    """Environment in which a child imports the same code as this process, with one thread per maths library."""
    path = os.pathsep.join(entry for entry in sys.path if entry)
    return os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"}


def last_line_of(log: Path) -> str:
    """Read the last line that a child wrote."""
    lines = log.read_text(errors="replace").strip().splitlines() if log.is_file() else []
    return lines[-1] if lines else "(it wrote nothing)"


def _die_with_parent(parent: int) -> None:
    """Let the kernel end this process when its parent ends, even by SIGKILL."""
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != parent:  # the parent ended before prctl took effect
        os._exit(128 + signal.SIGTERM)
