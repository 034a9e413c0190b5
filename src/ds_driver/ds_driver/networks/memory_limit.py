"""Limits the memory that loading and running a network file may take, whatever its size."""

from __future__ import annotations

import resource
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

NETWORK_MEMORY = 4 * 2**30
"""Bytes beyond what the process has already mapped; chosen: 40 times the largest shipped network."""

_lock = threading.Lock()
_inside = 0
_before = (resource.RLIM_INFINITY, resource.RLIM_INFINITY)


@contextmanager
def limited_memory(extra: int = NETWORK_MEMORY) -> Iterator[None]:
    """Make allocations fail beyond the present address space plus `extra` bytes.

    A graph of three nodes can ask for terabytes, and the runtimes set no limit. The limit applies to the whole process,
    other threads included; nested and concurrent uses keep the first limit.

    Args:
        extra: bytes that may be mapped in addition.
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
