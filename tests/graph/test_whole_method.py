"""The whole method through real nodes: the same bytes twice, stopped and resumed, and nothing left behind."""

from __future__ import annotations

import json
import os
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = pytest.mark.graph

DS = [sys.executable, "-m", "ds_orchestrator.cli"]
WHOLE = """
siblings: [bullet, softbody]
twin: donkey
driver: dave2
seed: 5
search: {population: 1, iterations: 1, runs: 1, min_angle: 40, max_angle: 120}
"""
SMALL = """
siblings: [bullet, donkey]
twin: null
driver: autopilot
seed: 3
search: {population: 2, iterations: 1, runs: 1, min_angle: 40, max_angle: 90}
"""


def executions(folder: Path) -> dict[tuple[str, str], tuple[str, str]]:
    """Empty as long as the campaign has made no table."""
    if not (folder / "campaign.sqlite").exists():
        return {}
    try:
        rows = sqlite3.connect(folder / "campaign.sqlite").execute(
            "SELECT test_id, simulator, outcome, trajectory_sha256 FROM executions"
        )
    except sqlite3.OperationalError:
        return {}
    return {(test_id, simulator): (outcome, sha) for test_id, simulator, outcome, sha in rows}


def children_of(pid: int) -> list[int]:
    return [int(p) for p in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()] + [
        int(p)
        for task in Path(f"/proc/{pid}/task").iterdir()
        for p in (task / "children").read_text().split()
        if task.name != str(pid)
    ]


def test_the_same_seed_gives_the_same_bytes_also_on_a_busy_machine(tmp_path: Path) -> None:
    """Two fresh graphs of all simulators with the network; both cores busy with something else the second time."""
    (tmp_path / "c.yaml").write_text(WHOLE)
    for name in ("first", "second"):
        busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2 * (name == "second"))]
        try:
            command = [*DS, "campaign", "run", str(tmp_path / "c.yaml"), "--out", str(tmp_path / name), "--json"]
            done = subprocess.run(command, capture_output=True, text=True, timeout=280)
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


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGKILL])
def test_a_stopped_campaign_leaves_no_process_and_goes_on(tmp_path: Path, stop: signal.Signals) -> None:
    (tmp_path / "c.yaml").write_text(SMALL)
    out = tmp_path / "out"
    command = [*DS, "campaign", "run", str(tmp_path / "c.yaml"), "--out", str(out), "--json"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 90.0
    while time.monotonic() < deadline:
        if len(executions(out)) >= 2:
            break
        time.sleep(0.1)
    children = children_of(process.pid)
    assert len(children) == 3
    process.send_signal(stop)
    _, errors = process.communicate(timeout=20.0)
    assert "Traceback" not in errors
    assert process.returncode == (130 if stop is signal.SIGINT else -signal.SIGKILL)
    deadline = time.monotonic() + 10.0
    while [p for p in children if os.path.exists(f"/proc/{p}")] and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not [p for p in children if os.path.exists(f"/proc/{p}")]
    kept = executions(out)
    assert 2 <= len(kept) < 12
    done = subprocess.run([*DS, "campaign", "resume", str(out), "--json"], capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr[-2000:]
    after = executions(out)
    assert len(after) == 12 and kept.items() <= after.items()
    driven = [line for line in done.stderr.splitlines() if " on " in line and "/12 " in line]
    assert len(driven) == 12 - len(kept)
    status = subprocess.run([*DS, "campaign", "status", str(out), "--json"], capture_output=True, text=True, check=True)
    assert json.loads(status.stdout)["executions"] == 12
