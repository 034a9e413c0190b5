"""Records every comparison with an oracle, which `python -m benchmarks.evidence` prints as tables."""

from __future__ import annotations

import json
from collections.abc import Callable

import pytest

Compare = Callable[..., None]


@pytest.fixture
def compare(record_property: Callable[[str, object], None]) -> Compare:
    """Function that asserts that a measured value equals an oracle's within a tolerance, and records both."""

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
