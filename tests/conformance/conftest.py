# SPDX-License-Identifier: Apache-2.0
"""Simulators under test: all registered ones, the example of the documentation, and those named by option.

`pytest tests/conformance --simulator module:Class` tests only your simulator.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from ds_sim.registry import STANDARD, simulator_class, simulators
from ds_sim.testing import missing_because

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
EXAMPLE = "bicycle:BicycleSimulator"


@pytest.fixture(scope="session", autouse=True)
def _examples_on_path() -> Iterator[None]:
    """Make the example importable in this process and its children."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(EXAMPLES)
        patch.setenv("PYTHONPATH", str(EXAMPLES), prepend=os.pathsep)
        yield


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run every test with the fixture of a simulator once per simulator."""
    if "simulator_name" in metafunc.fixturenames:
        metafunc.parametrize("simulator_name", [_if_there(name) for name in _names(metafunc.config)])


@pytest.fixture(scope="session")
def all_simulator_names(request: pytest.FixtureRequest) -> list[str]:
    return [name for name in _names(request.config) if not _reason_to_skip(name)]


def _if_there(name: str) -> Any:
    """The name of a simulator, whose tests are skipped where it needs what set-up does not install."""
    reason = _reason_to_skip(name)
    return pytest.param(name, marks=pytest.mark.skip(reason=reason)) if reason else name


def _reason_to_skip(name: str) -> str:
    return missing_because(name) if name in simulators() and name not in STANDARD else ""


def _names(config: pytest.Config) -> list[str]:
    return config.getoption("simulator") or [
        *(name for name in sorted(simulators()) if not simulator_class(name).needs_file),
        EXAMPLE,
    ]
