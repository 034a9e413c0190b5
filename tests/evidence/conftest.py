# SPDX-License-Identifier: Apache-2.0
"""Records every comparison with an oracle; `pytest -v tests/evidence` prints them as Markdown tables."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
from tests.evidence.subjects import SUBJECTS, Subject, started

from ds_sim.parts import Vehicle

Compare = Callable[..., None]


@pytest.fixture(params=sorted(SUBJECTS))
def subject(request: pytest.FixtureRequest) -> Subject:
    return SUBJECTS[request.param]()


@pytest.fixture
def car(subject: Subject) -> Iterator[Vehicle]:
    vehicle = started(subject)
    yield vehicle
    vehicle.close()


@pytest.fixture
def compare(record_property: Callable[[str, object], None]) -> Compare:
    """Function that asserts that a measured value equals an oracle's within a tolerance, and records both."""

    def check(
        vehicle: str,
        quantity: str,
        oracle: str,
        measured: float,
        expected: float,
        *,
        rel: float = 0.0,
        off: float = 0.0,
    ) -> None:
        tolerance = f"{100.0 * rel:g}%" if rel else f"{float(f'{off:.2g}'):g}"
        row = [vehicle, quantity, oracle, float(expected), float(measured), tolerance]
        record_property("evidence", row)
        assert measured == pytest.approx(expected, rel=rel, abs=off)

    return check


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Print a table for each vehicle (docs/data/simulator_oracles.csv)."""
    reports = [*terminalreporter.getreports("passed"), *terminalreporter.getreports("failed")]
    rows = [value for report in reports for name, value in report.user_properties if name == "evidence"]
    for vehicle in sorted({row[0] for row in rows}) if terminalreporter.verbosity > 0 else []:
        head = "| quantity | oracle | oracle's value | measured | tolerance |\n|---|---|---|---|---|"
        terminalreporter.write_line(f"\n{vehicle}\n\n{head}")
        for _, quantity, oracle, expected, measured, tolerance in (row for row in rows if row[0] == vehicle):
            values = " | ".join(f"{round(value, 3) + 0.0:.3g}" for value in (expected, measured))
            terminalreporter.write_line(f"| {quantity} | {oracle} | {values} | {tolerance} |")
