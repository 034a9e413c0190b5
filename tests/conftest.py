"""Options of the tests."""

from __future__ import annotations

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    """`--simulator module:Class` runs the conformance suite over that simulator alone; may be given again."""
    parser.addoption("--simulator", action="append", default=[], help="simulator for the conformance suite")
