"""Spreads independent work over processes, in order, so that the result does not depend on their number."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import TypeVar

Job = TypeVar("Job")
Answer = TypeVar("Answer")


def map_in_processes(
    work: Callable[[Job], Answer], jobs: Sequence[Job], *, workers: int | None = None
) -> Iterator[Answer]:
    """Do every job in worker processes with one maths thread each.

    Args:
        work: a function of a module, that draws on nothing but its argument.
        jobs: its arguments.
        workers: processes; the processors of this machine if left out.

    Yields:
        Each job's answer as soon as it and all before it are there.
    """
    count = min(workers or len(os.sched_getaffinity(0)), max(len(jobs), 1))
    context = multiprocessing.get_context("spawn")
    threads = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = "1"  # children inherit it; set in the child it would come after its imports
    try:
        with ProcessPoolExecutor(count, mp_context=context, initializer=_begin) as pool:
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


def _begin() -> None:
    """Leave Ctrl-C to the parent, which stops the pool, and die with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """A parent that was killed cannot stop its pool."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
