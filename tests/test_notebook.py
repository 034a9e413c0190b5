# SPDX-License-Identifier: Apache-2.0
"""The code of examples/first_look.ipynb runs in an empty folder, with a driver that is quicker than a network."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
NETWORK = 'DRIVER = "dave2_short"'


@pytest.fixture(scope="module")
def cells() -> list[dict[str, str]]:
    document = json.loads((EXAMPLES / "first_look.ipynb").read_text())
    assert document["nbformat"] == 4 and not any(cell.get("outputs") for cell in document["cells"])
    return [{"type": cell["cell_type"], "text": "".join(cell["source"])} for cell in document["cells"]]


def test_every_cell_runs_and_the_last_one_names_every_drive(tmp_path: Path, cells: list[dict[str, str]]) -> None:
    script = "\n".join(cell["text"] for cell in cells if cell["type"] == "code")
    assert script.count(NETWORK) == 1
    script = "import sys\nsys.modules['rclpy'] = None\n" + script.replace(NETWORK, 'DRIVER = "autopilot"')
    env = os.environ | {"MPLBACKEND": "agg"}
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, env=env, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    first, *_ = done.stdout.splitlines()
    assert re.match(r"[A-Z_]+ after [\d.]+ s, closest to the edge of the lane: -?[\d.]+ m", first)
    drives = re.findall(r"^(softbody-0-000\d) +(\w+) +(\w+) +[+-]", done.stdout, re.MULTILINE)
    assert {(test, simulator) for test, simulator, _ in drives} == {
        (f"softbody-0-000{number}", name) for number in (0, 1) for name in ("softbody", "donkey")
    }
    assert (tmp_path / "first_look" / "report.html").is_file()
