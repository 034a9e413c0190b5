"""Prints the results of tests/evidence as Markdown tables: `python -m benchmarks.evidence`.

Runs the tests with pytest and prints every comparison with an oracle per vehicle (docs/data/simulator_oracles.csv);
the exit status is that of pytest.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from xml.etree import ElementTree

import pytest

FOLDER = Path(__file__).resolve().parent.parent / "tests" / "evidence"


def main() -> int:
    """Print the tables."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        options = ["-q", "--no-header", "-o", "junit_family=xunit1", f"--junitxml={report}"]
        status = pytest.main([*options, str(FOLDER), *sys.argv[1:]])
        found = [
            json.loads(p.attrib["value"])
            for p in ElementTree.parse(report).iter("property")
            if p.attrib["name"] == "evidence"
        ]
    for vehicle in sorted({row[0] for row in found}):
        print(f"\n{vehicle}\n\n| quantity | oracle | oracle's value | measured | tolerance |\n|---|---|---|---|---|")
        for _, quantity, oracle, expected, measured, tolerance in (row for row in found if row[0] == vehicle):
            print(f"| {quantity} | {oracle} | {_number(expected)} | {_number(measured)} | {tolerance} |")
    return int(status)


def _number(value: float) -> str:
    """Format with three significant digits and at most three decimals."""
    return f"{round(value, 3) + 0.0:.3g}"


if __name__ == "__main__":
    sys.exit(main())
