"""Which simulators the suite runs over: all that are registered, the document's example, and any that is named.

`pytest tests/conformance --simulator module:Class` tests one of your own, and nothing else.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from ds_sim.registry import SIMULATORS

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
EXAMPLE = "bicycle:BicycleSimulator"


@pytest.fixture(scope="session", autouse=True)
def _examples_on_path() -> Iterator[None]:
    """Let this process and its children import the example."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(EXAMPLES)
        patch.setenv("PYTHONPATH", str(EXAMPLES), prepend=os.pathsep)
        yield


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run every test that asks for a simulator once per simulator."""
    if "simulator_name" in metafunc.fixturenames:
        metafunc.parametrize("simulator_name", _names(metafunc.config))


@pytest.fixture(scope="session")
def all_simulator_names(request: pytest.FixtureRequest) -> list[str]:
    return _names(request.config)


def _names(config: pytest.Config) -> list[str]:
    return config.getoption("simulator") or [*sorted(SIMULATORS), EXAMPLE]
