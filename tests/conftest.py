# SPDX-License-Identifier: Apache-2.0
"""Command-line options of the tests."""

from __future__ import annotations

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add `--simulator` and `--moments`.

    `--simulator module:Class` runs the conformance suite on that simulator alone; it may be repeated. `--moments 25`
    with `-m long` kills a campaign's processes 25 times.
    """
    parser.addoption("--simulator", action="append", default=[], help="simulator for the conformance suite")
    parser.addoption("--moments", type=int, default=7, help="moments at which a campaign's processes are killed")
