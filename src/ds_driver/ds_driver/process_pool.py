"""Distributes independent jobs over processes, with results in order and independent of the number of processes."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import TypeVar

Job = TypeVar("Job")
Result = TypeVar("Result")


def map_in_processes(
    work: Callable[[Job], Result], jobs: Sequence[Job], *, workers: int | None = None
) -> Iterator[Result]:
    """Run jobs in worker processes with one OpenMP thread each.

    Args:
        work: module-level function that depends on its argument only.
        jobs: arguments of `work`.
        workers: number of processes; the number of available processors if None.

    Yields:
        Result of each job, in order.
    """
    count = min(workers or len(os.sched_getaffinity(0)), max(len(jobs), 1))
    context = multiprocessing.get_context("spawn")
    threads = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = "1"  # inherited; in the child it would come after the imports
    try:
        with ProcessPoolExecutor(count, mp_context=context, initializer=_start_worker) as pool:
            try:
                yield from pool.map(work, jobs)
            except BaseException:
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
    threading.Thread(target=_exit_with_parent, daemon=True).start()


def _exit_with_parent() -> None:
    """Exit when the parent ends; a parent that was killed cannot stop its pool."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
