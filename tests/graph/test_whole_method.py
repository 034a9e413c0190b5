# SPDX-License-Identifier: Apache-2.0
"""The whole method with every engine: the same bytes each time; `test_kill.py` stops and resumes it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from benchmarks.kill import stored
from tests.command_line import ds_process

pytestmark = pytest.mark.graph

WHOLE = """
siblings: [bullet, softbody]
twin: donkey
driver: dave2
seed: 5
search: {population: 1, iterations: 1, runs: 1, min_angle: 40, max_angle: 120}
"""


@pytest.mark.long
@pytest.mark.timeout(1200)  # the test loads both cores on purpose
def test_the_same_seed_gives_the_same_bytes_with_any_engine_also_on_a_busy_machine(tmp_path: Path) -> None:
    """All simulators with a network: two graphs, the second while other processes load both cores, then the others."""
    (tmp_path / "c.yaml").write_text(WHOLE)
    runs = {"graph": (), "busy": (), "local": ("--workers", "2"), "dask": ("--workers", "2")}
    for name, options in runs.items():
        busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2 * (name == "busy"))]
        engine = "graph" if name == "busy" else name
        try:
            words = ("campaign", "run", tmp_path / "c.yaml", "--out", tmp_path / name, "--json", "--engine", engine)
            done = ds_process(*words, *options, timeout=400)
        finally:
            for process in busy:
                process.kill()
        assert done.returncode == 0, done.stderr[-2000:]
        document = json.loads(done.stdout)
        assert document["executions"] == 12 and document["executions_in_error"] == 0
        assert Path(document["report"]).is_file()
    first = tmp_path / "graph"
    assert len(stored(first)) == 12
    files = {path.relative_to(first) for part in ("maps/*.json", "bags/*/*") for path in first.glob(part)}
    assert {Path("maps/merged.json"), Path("maps/twin_donkey.json")} <= files and len(files) > 24
    for name in ("busy", "local", "dask"):
        assert stored(tmp_path / name) == stored(first), name
        for file in sorted(files):
            assert (tmp_path / name / file).read_bytes() == (first / file).read_bytes(), f"{name}: {file}"
    assert document("maps", first) == json.loads((first / "maps" / "maps.json").read_text())
