"""The whole method through real nodes: the same bytes twice; `test_kill.py` stops and resumes it."""

from __future__ import annotations

import json
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.graph

DS = [sys.executable, "-m", "ds_orchestrator.cli.main"]
WHOLE = """
siblings: [bullet, softbody]
twin: donkey
driver: dave2
seed: 5
search: {population: 1, iterations: 1, runs: 1, min_angle: 40, max_angle: 120}
"""


def executions(folder: Path) -> dict[tuple[str, str], tuple[str, str]]:
    """Read outcome and digest of every execution; empty until the campaign has created its tables."""
    if not (folder / "campaign.sqlite").exists():
        return {}
    try:
        rows = sqlite3.connect(folder / "campaign.sqlite").execute(
            "SELECT test_id, simulator, outcome, trajectory_sha256 FROM executions"
        )
    except sqlite3.OperationalError:
        return {}
    return {(test_id, simulator): (outcome, sha) for test_id, simulator, outcome, sha in rows}


@pytest.mark.long
@pytest.mark.timeout(600)  # the test loads both cores on purpose
def test_the_same_seed_gives_the_same_bytes_also_on_a_busy_machine(tmp_path: Path) -> None:
    """Two new graphs of all simulators with the network; the second time, other processes load both cores."""
    (tmp_path / "c.yaml").write_text(WHOLE)
    for name in ("first", "second"):
        busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2 * (name == "second"))]
        try:
            command = [*DS, "campaign", "run", str(tmp_path / "c.yaml"), "--out", str(tmp_path / name), "--json"]
            done = subprocess.run(command, capture_output=True, text=True, timeout=400)
        finally:
            for process in busy:
                process.kill()
        assert done.returncode == 0, done.stderr[-2000:]
        document = json.loads(done.stdout)
        assert document["executions"] == 12 and document["executions_in_error"] == 0
        assert Path(document["report"]).is_file()
    first, second = tmp_path / "first", tmp_path / "second"
    assert executions(first) == executions(second) and len(executions(first)) == 12
    maps = sorted(p.name for p in (first / "maps").glob("*.json"))
    assert "merged.json" in maps and "twin_donkey.json" in maps
    for name in maps:
        assert (first / "maps" / name).read_bytes() == (second / "maps" / name).read_bytes(), name
    bags = sorted(p.name for p in (first / "bags").iterdir())
    assert len(bags) == 12
    for name in bags:
        recorded = [(folder / "bags" / name / f"{name}.mcap").read_bytes() for folder in (first, second)]
        assert recorded[0] == recorded[1], name
    shown = subprocess.run([*DS, "maps", str(first), "--json"], capture_output=True, text=True, check=True)
    assert json.loads(shown.stdout) == json.loads((first / "maps" / "maps.json").read_text())
