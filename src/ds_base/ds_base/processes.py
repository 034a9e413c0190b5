# SPDX-License-Identifier: Apache-2.0
"""Child processes that never outlive this one, pools of processes for independent jobs, and the clock of waits."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import TypeVar

from ds_base.errors import RunError

_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None)
USER_DOMAIN = "DS_USER_ROS_DOMAIN_ID"
"""Variable with the user's ROS domain, in the processes of a graph that has a domain of its own."""
LONGEST_LOOK = 3.0
"""Time between two looks at the clock beyond which this process stood still, s; chosen: a busy machine stays below."""
Job = TypeVar("Job")
Result = TypeVar("Result")


class NoSemaphoreError(RunError):
    """A machine on which Python's processes cannot share a semaphore."""


def check_semaphores() -> None:
    """Raise an error unless processes can share semaphores, which lie in `/dev/shm`; pools and Dask need them."""
    try:
        multiprocessing.get_context("spawn").Semaphore()
    except OSError as error:
        raise NoSemaphoreError(
            f"/dev/shm takes no semaphore ({error.strerror}), and processes that share work need one: mount it, make "
            "room, or let this user write there"
        ) from None


class ChildProcesses:
    """Starts children from one lasting thread: the kernel ends a child when the thread that created it ends."""

    def __init__(self) -> None:
        self._spawner = ThreadPoolExecutor(1, thread_name_prefix="spawner")

    def start(
        self, command: Sequence[str], *, environment: Mapping[str, str], log: Path, pass_fds: Sequence[int] = ()
    ) -> subprocess.Popen[bytes]:
        """Start a child in a session of its own, so that Ctrl-C in the terminal reaches only this process.

        It has the given environment only, and inherits the descriptors `pass_fds`; what it prints is appended to `log`.
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


def map_in_processes(
    work: Callable[[Job], Result], jobs: Sequence[Job], *, workers: int | None = None, abandon: bool = False
) -> Iterator[Result]:
    """Run jobs in worker processes with one OpenMP thread each, and yield the results in order.

    `work` is a module-level function that depends on its argument only; if `workers` is None, there are as many as
    available processors. On Ctrl-C the running jobs are finished; with `abandon` they are ended at once.
    """
    check_semaphores()
    count = min(workers or len(os.sched_getaffinity(0)), max(len(jobs), 1))
    context = multiprocessing.get_context("spawn")
    threads = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = "1"  # inherited; in the child it would come after the imports
    others = set(multiprocessing.active_children())
    try:
        with ProcessPoolExecutor(count, mp_context=context, initializer=_start_worker) as pool:
            try:
                # Workers begin with Ctrl-C blocked: while they import, they would print a traceback.
                signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
                try:
                    results = [pool.submit(work, job) for job in jobs]
                finally:
                    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
                while results:
                    yield results.pop(0).result()
            except BaseException as error:
                if abandon and isinstance(error, KeyboardInterrupt):
                    for worker in set(multiprocessing.active_children()) - others:
                        worker.terminate()
                else:
                    pool.shutdown(wait=False, cancel_futures=True)
                raise
    finally:
        if threads is None:
            del os.environ["OMP_NUM_THREADS"]
        else:
            os.environ["OMP_NUM_THREADS"] = threads


def _start_worker() -> None:
    """Ignore Ctrl-C, on which the parent stops the pool, and exit with the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})  # for its own children
    threading.Thread(target=_exit_with_parent, daemon=True).start()


def _exit_with_parent() -> None:
    """Exit when the parent ends; a parent that was killed cannot stop its pool."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


class RunningClock:
    """Monotonic clock that stands still with its process: stopped by a signal, or in a paused container or machine.

    Whoever waits for another process looks at it at least every `LONGEST_LOOK` s, and after a pause blames nobody for
    what this process could not hear.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._looked, self._paused = time.monotonic(), 0.0

    def now(self) -> float:
        """Time of the clock, s; a pause counts as `LONGEST_LOOK`."""
        with self._lock:
            at = time.monotonic()
            self._paused += max(0.0, at - self._looked - LONGEST_LOOK)
            self._looked = at
            return at - self._paused
