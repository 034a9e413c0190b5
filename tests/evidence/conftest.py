"""Every comparison with an oracle is noted: `python -m benchmarks.evidence` prints the tables of docs/simulators.md."""

from __future__ import annotations

import json
from collections.abc import Callable

import pytest

Compare = Callable[..., None]


@pytest.fixture
def compare(record_property: Callable[[str, object], None]) -> Compare:
    """Asserts that a measured value is an oracle's within a tolerance, and notes both as a property of the test."""

    def check(
        vehicle: str,
        quantity: str,
        oracle: str,
        *,
        measured: float,
        expected: float,
        rel: float = 0.0,
        off: float = 0.0,
    ) -> None:
        tolerance = f"{100.0 * rel:g} %" if rel else f"{float(f'{off:.2g}'):g}"
        row = [vehicle, quantity, oracle, float(expected), float(measured), tolerance]
        record_property("evidence", json.dumps(row))
        assert measured == pytest.approx(expected, rel=rel, abs=off)

    return check
