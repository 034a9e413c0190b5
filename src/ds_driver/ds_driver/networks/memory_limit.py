"""Limits the memory that a network file may take, in a file of a few hundred bytes as in one of gigabytes."""

from __future__ import annotations

import resource
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

NETWORK_MEMORY = 4 * 2**30
"""Bytes beside what the process has mapped already; chosen: 40 times the largest shipped network."""

_lock = threading.Lock()
_inside = 0
_before = (resource.RLIM_INFINITY, resource.RLIM_INFINITY)


@contextmanager
def limited_memory(extra: int = NETWORK_MEMORY) -> Iterator[None]:
    """Let allocations fail that would take the process further than so many bytes beyond its present address space.

    A graph of three nodes can ask for terabytes, and the runtimes have no limit of their own. The limit is the
    process's, so that other threads share it meanwhile; nested and concurrent uses keep the first one's limit.
    """
    global _inside, _before
    with _lock:
        _inside += 1
        if _inside == 1:
            _before = resource.getrlimit(resource.RLIMIT_AS)
            pages = int(Path("/proc/self/statm").read_text().split()[0])
            wanted = pages * resource.getpagesize() + extra
            limits = [limit for limit in (*_before, wanted) if limit != resource.RLIM_INFINITY]
            resource.setrlimit(resource.RLIMIT_AS, (min(limits), _before[1]))
    try:
        yield
    finally:
        with _lock:
            _inside -= 1
            if _inside == 0:
                resource.setrlimit(resource.RLIMIT_AS, _before)
