"""Options of the tests."""

from __future__ import annotations

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    """`--simulator module:Class` runs the conformance suite over that simulator alone; may be given again.

    `--moments 25` with `-m long` kills a campaign's processes that often; `python -m benchmarks.kill` prints a table.
    """
    parser.addoption("--simulator", action="append", default=[], help="simulator for the conformance suite")
    parser.addoption("--moments", type=int, default=7, help="moments at which a campaign's processes are killed")
