# SPDX-License-Identifier: Apache-2.0
"""Settings of all tests: threads per process, the order of files for parallel workers, and the browser."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Browser

# Workers run in parallel and start further processes: one thread each for linear algebra. NumPy and PyTorch read this
# when they are imported.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

LONGEST_FIRST = (
    "tests/graph/test_kill.py",
    "tests/graph/test_runs_and_roads.py",
    "tests/conformance/test_nodes.py",
    "tests/conformance/test_simulators.py",
)
"""Files that take longest, so that no worker starts one when the other workers have finished."""
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """Headless Chromium: where it is missing, CI fails, and a user's tests are skipped."""
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    try:
        from playwright.sync_api import sync_playwright
    except ModuleNotFoundError:
        program = None
    if program is None:
        missing = "no Chromium, or no playwright: apt install chromium, then `make test`"
        pytest.fail(missing) if os.environ.get("CI") else pytest.skip(missing)
    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=program, args=["--no-sandbox", "--disable-gpu"])
        yield started
        started.close()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Sort files: the longest first, then those that start graphs, then the others; order within a file stays."""

    def rank(item: pytest.Item) -> tuple[int, bool]:
        file = item.nodeid.partition("::")[0]
        place = LONGEST_FIRST.index(file) if file in LONGEST_FIRST else len(LONGEST_FIRST)
        return place, file not in with_graphs

    with_graphs = {item.nodeid.partition("::")[0] for item in items if item.get_closest_marker("graph")}
    items.sort(key=rank)
