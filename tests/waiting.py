# SPDX-License-Identifier: Apache-2.0
"""Waits for what other threads and processes do."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")


def wait_until(done: Callable[[], T], limit: float = 60.0) -> T:
    """Ask again and again until the answer is true, and return it; fails after the limit, s."""
    deadline = time.monotonic() + limit
    while not (answer := done()):
        assert time.monotonic() < deadline, f"not within {limit:g} s"
        time.sleep(0.05)
    return answer
