# SPDX-License-Identifier: Apache-2.0
"""Commands that `ds` prints can be typed as they are: they name verbs that exist, and run where they were printed."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest
from tests.campaign.engines import MadeUpEngine, use_engines
from tests.command_line import ds
from tests.drives import driven

from ds_bags.run_writer import write_bag
from ds_base.installation import ds_command
from ds_orchestrator.campaign.config import read_config
from ds_orchestrator.campaign.folder import store_of
from ds_sim.registry import DONKEY
from ds_sim.testing import STRAIGHT

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder in which `ds` is started; engines drive nothing."""
    use_engines(monkeypatch, lambda _: MadeUpEngine(runs=10_000))
    folder = tmp_path / "a user's folder"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder


def printed(text: str) -> list[str]:
    """The words after `ds` of the command in a line."""
    (command,) = re.findall(r"(?:next: |`)(ds [^`\n]+)", text)
    return shlex.split(command)[1:]


def test_a_dry_run_prints_what_runs_next(here: Path) -> None:
    forecast = ds("test", "autopilot", "--dry-run", "--out", "my runs/it's one")
    assert forecast.returncode == 0 and "72 drives at most" in forecast.stdout, forecast.stderr
    words = printed(forecast.stderr)
    assert words[:2] == ["campaign", "run"] and "driver: autopilot" in Path(words[2]).read_text()
    assert ds(*words, "--workers", "0").returncode == 2


def test_a_campaign_without_drives_says_how_it_goes_on(here: Path) -> None:
    Path("c.yaml").write_text("{driver: autopilot, engine: local, search: {population: 1, iterations: 0, runs: 1}}")
    Path("my campaign").mkdir()
    store_of(Path("my campaign"), read_config(Path("c.yaml"))).close()
    for verb in (("compare", "my campaign", "dave2"), ("suite", "make", "my campaign")):
        refused = ds(*verb)
        assert refused.returncode == 2, refused.stderr
        words = printed(refused.stderr)
        assert words == ["campaign", "resume", "my campaign"]
    resumed = ds(*words)
    assert resumed.returncode == 0, resumed.stderr
    assert Path(resumed.stdout.splitlines()[-1]).is_file()
    # A moved campaign finds its bags.
    moved = Path("my campaign").rename("moved")
    assert list(moved.glob("bags/*/metadata.yaml"))
    assert json.loads(ds("campaign", "status", moved, "--json").stdout)["missing_bags"] == []
    shutil.rmtree(moved / "bags")
    assert len(json.loads(ds("campaign", "status", moved, "--json").stdout)["missing_bags"]) > 0


@pytest.mark.parametrize(
    ("verb", "words"),
    [
        (("models",), ["check", "dave2"]),
        (
            ("collect", "--out", "my data", "--roads", "1", "--sims", "donkey", "--every", "50"),
            ["train", "--data", "my data", "--out", "networks"],
        ),
    ],
)
def test_a_verb_ends_with_what_comes_next(here: Path, verb: tuple[str, ...], words: list[str]) -> None:
    done = ds(*verb)
    assert done.returncode == 0 and printed(done.stderr) == words, done.stderr
    assert ds(*words[:1], "--help").returncode == 0


def test_an_unfinished_bag_says_how_it_is_completed(here: Path) -> None:
    write_bag(Path("my bag"), "/ds1", DONKEY, driven("donkey", STRAIGHT), {"driver": "autopilot"}, "telemetry")
    Path("my bag/metadata.yaml").unlink()
    (file,) = Path("my bag").iterdir()
    file.write_bytes(file.read_bytes()[:-100])  # the recorder was killed before it wrote the end
    refused = ds("bag", "info", "my bag")
    assert refused.returncode == 2, refused.stdout
    done = ds(*printed(refused.stderr))
    assert done.returncode == 0 and Path("DIR/metadata.yaml").is_file(), done.stderr


def test_a_command_begins_as_the_one_that_printed_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert ds_command("report", Path("my out")) == "ds report 'my out'"
    monkeypatch.setenv("DS_COMMAND", "./ds")
    assert ds_command("report", "out") == "./ds report out"
    command = ["./ds", "road", "show", "--out", str(tmp_path / "road.png")]
    env = {"DS_COMMAND": "other"}
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, timeout=120, env=os.environ | env)
    assert "next: ./ds drive --sim bullet" in done.stderr, done.stderr
