# SPDX-License-Identifier: Apache-2.0
"""Unusable and received folders: one clear line, a non-zero exit status, no byte changed, and no code run."""

from __future__ import annotations

import hashlib
import sqlite3
import struct
import subprocess
import sys
import tracemalloc
import zlib
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from report_campaigns import make_campaign
from tests.campaign.damaged_stores import change_store, write_as_version_4
from tests.campaign.engines import MadeUpEngine
from tests.campaign.test_campaign import run
from tests.command_line import ds, refusal

from ds_base.folder_files import StoreError, locked
from ds_driver.networks.driver_name import AUTOPILOT, DriverName, received_driver
from ds_orchestrator.campaign.config import CampaignConfig, ConfigError, SearchConfig, read_config
from ds_orchestrator.campaign.folder import open_store, read_campaign
from ds_orchestrator.store.model import Test
from ds_orchestrator.store.rows import trajectory_sha256
from ds_orchestrator.store.store import Store
from ds_road import Road, Side
from ds_sim import DONKEY
from ds_sim.scenario import MAX_SEED, Scenario, ScenarioError

CONFIG = """
siblings: [donkey]
twin: null
driver: autopilot
seed: 7
record: none
search: {population: 2, iterations: 2, runs: 1, min_angle: 40, max_angle: 90}
"""


@pytest.fixture
def mount(tmp_path: Path) -> Iterator[Callable[..., Path]]:
    """Mount something on a folder; skips if that is not allowed."""
    mounted: list[Path] = []

    def begin(folder: Path, *arguments: str) -> Path:
        folder.mkdir(exist_ok=True)
        done = subprocess.run(["mount", *arguments, str(folder)], capture_output=True, check=False)
        if done.returncode:
            pytest.skip("only root may mount")
        mounted.append(folder)
        return folder

    yield begin
    for folder in mounted:
        subprocess.run(["umount", "-l", str(folder)], check=True)


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "c.yaml"
    path.write_text(CONFIG)
    return path


@pytest.fixture
def campaign(tmp_path: Path, config: Path) -> Path:
    """A campaign that was stopped after two of four tests."""
    run(tmp_path / "out", MadeUpEngine(runs=2), read_config(config))[1].close()
    return tmp_path / "out"


def content(folder: Path) -> dict[str, str]:
    """Map every file to the hash of its content; the empty lock is left out."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != ".lock")
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def change(folder: Path, statement: str, *values: object) -> None:
    change_store(folder / "campaign.sqlite", statement, *values)


def tear(folder: Path) -> None:
    """Overwrite the second page, to which the schema in the first page refers."""
    with (folder / "campaign.sqlite").open("r+b") as file:
        file.seek(4096)
        file.write(b"\xff" * 4096)


def foreign(folder: Path) -> None:
    (folder / "campaign.sqlite").unlink()
    change(folder, "CREATE TABLE sales (euro INTEGER)")


def folder_instead(folder: Path) -> None:
    (folder / "campaign.sqlite").unlink()
    (folder / "campaign.sqlite").mkdir()


SPOILT: dict[str, tuple[Callable[[Path], object], str]] = {
    "another version": (
        lambda f: change(f, "PRAGMA user_version=99"),
        "was written by another version of ds (schema 99, expected 5)",
    ),
    "foreign": (foreign, "is not a campaign's store"),
    "a table is missing": (lambda f: change(f, "DROP TABLE given_up"), "is not a campaign's store"),
    "no database": (lambda f: (f / "campaign.sqlite").write_bytes(b"something else " * 1000), "is damaged"),
    "torn": (tear, "is damaged"),
    "a folder": (folder_instead, "is a folder, expected a campaign's store"),
}


@pytest.mark.parametrize("how", SPOILT)
def test_a_store_that_cannot_be_used_is_left_as_it_is(campaign: Path, config: Path, how: str) -> None:
    spoil, named = SPOILT[how]
    spoil(campaign)
    before = content(campaign)
    for arguments in (("campaign", "run", config, "--out", campaign), ("campaign", "status", campaign)):
        said = refusal(*arguments)
        assert named in said and str(campaign) in said and said.startswith("error: "), said
        assert content(campaign) == before


def test_damage_within_a_run_is_named(tmp_path: Path, campaign: Path) -> None:
    change(campaign, "UPDATE executions SET trajectory=x'ffff' WHERE test_id='donkey-0-0001'")
    before = content(campaign)
    for verb in (("report", campaign), ("campaign", "export", campaign, "--frames", "--out", tmp_path)):
        problem = "is damaged (the run of donkey-0-0001 on donkey cannot be read: trajectory is damaged)"
        done = ds(*verb)
        assert done.returncode == 2 and problem in done.stderr
        assert content(campaign) == before


def test_only_verbs_that_need_trajectories_decode_them(campaign: Path) -> None:
    change(campaign, "UPDATE executions SET trajectory=x'ffff', steering=x'ffff'")
    for verb in (("campaign", "status"), ("campaign", "roads"), ("maps",)):
        assert ds(*verb, campaign).returncode == 0


def test_another_configuration_is_refused_key_by_key(campaign: Path, config: Path) -> None:
    config.write_text(config.read_text().replace("seed: 7", "seed: 8").replace("iterations: 2", "iterations: 3"))
    before = content(campaign)
    said = refusal("campaign", "run", config, "--out", campaign)
    assert "(search.iterations: 2 there, 3 now; seed: 7 there, 8 now)" in said
    assert content(campaign) == before


def test_a_folder_in_use_is_refused(campaign: Path, config: Path) -> None:
    before = content(campaign)
    with locked(campaign):
        said = refusal("campaign", "run", config, "--out", campaign, status=1)
    assert said == f"error: {campaign} is in use by another run: wait for it, or choose another --out"
    assert content(campaign) == before


def test_a_folder_with_foreign_files_is_refused(tmp_path: Path, config: Path) -> None:
    (tmp_path / "mine" / "maps").mkdir(parents=True)
    (tmp_path / "mine" / "maps" / "maps.json").write_text("[]")
    before = content(tmp_path)
    assert "holds maps but no campaign" in refusal("campaign", "run", config, "--out", tmp_path / "mine")
    assert "no campaign in" in refusal("campaign", "status", tmp_path / "mine")
    assert "is a file, expected a folder" in refusal("campaign", "run", config, "--out", config)
    assert content(tmp_path) == before


def test_a_read_only_folder_is_read_and_not_run(campaign: Path, config: Path, mount: Callable[..., Path]) -> None:
    mount(campaign, "--bind", "-o", "ro", str(campaign))
    before = content(campaign)
    assert "cannot be written" in refusal("campaign", "run", config, "--out", campaign, status=1)
    status = ds("campaign", "status", campaign)
    assert (status.returncode, status.stderr.strip()) == (0, f"next: ds campaign resume {campaign}")
    with pytest.raises(StoreError, match="cannot be written"):
        Store(campaign / "campaign.sqlite", config=read_config(config).identity())
    assert refusal("report", campaign)
    assert content(campaign) == before


def test_a_process_that_was_killed_before_it_wrote_anything_leaves_a_folder_to_begin_in(tmp_path: Path) -> None:
    (tmp_path / "campaign.sqlite").touch()
    with pytest.raises(StoreError, match="stopped before it started"):
        Store(tmp_path / "campaign.sqlite")
    assert Store(tmp_path / "campaign.sqlite", config="{}").config == "{}"


@pytest.mark.parametrize("command", ["campaign run {config} --engine dask --out {out}", "check dave2 --out {out}"])
def test_without_shared_memory_a_line_says_who_needs_it(tmp_path: Path, config: Path, command: str) -> None:
    read_only = ["unshare", "-rm", "sh", "-c", 'mount -t tmpfs -o ro none /dev/shm && exec "$@"', "sh"]
    if subprocess.run([*read_only, "true"], capture_output=True, check=False).returncode:
        pytest.skip("may not mount")
    ds = [sys.executable, "-m", "ds_cli.main", *command.format(config=config, out=tmp_path / "out").split()]
    done = subprocess.run([*read_only, *ds], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert done.stderr.startswith("error: /dev/shm takes no semaphore (Read-only file system)")


SEARCH = SearchConfig(population=1, iterations=1, runs=1)
FINISHED = CampaignConfig(siblings=[DONKEY], twin=None, driver=AUTOPILOT, record="none", search=SEARCH)


def make(folder: Path, config: CampaignConfig = FINISHED) -> Path:
    """Create a finished campaign of two tests."""
    folder.mkdir()
    make_campaign(folder, config, 2).close()
    return folder


@pytest.fixture
def evil(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An importable module that leaves a trace when it is imported."""
    code = tmp_path / "code"
    code.mkdir()
    (code / "evilmod.py").write_text(
        f"from pathlib import Path\nPath({str(tmp_path / 'trace')!r}).touch()\n"
        "from ds_twin_donkey.simulator import DonkeySimulator\n\n\n"
        "class S(DonkeySimulator):\n    pass\n\n\nclass D:\n    def drive(self, seen):\n        return 0.0\n"
    )
    monkeypatch.syspath_prepend(str(code))
    yield tmp_path / "trace"
    sys.modules.pop("evilmod", None)


@pytest.mark.parametrize("received", [{"siblings": ["evilmod:S"]}, {"twin": "evilmod:S"}, {"driver": "evilmod:D"}])
def test_no_verb_imports_what_a_received_campaign_names(
    tmp_path: Path, evil: Path, received: dict[str, object]
) -> None:
    config = CampaignConfig.model_validate({**FINISHED.model_dump(), **received})
    folder = make(tmp_path / "received", config)
    for verb, following in ((("campaign", "status"), "campaign resume"), (("maps",), "report")):
        done = ds(*verb, folder)
        assert (done.returncode, done.stderr) == (0, f"next: ds {following} {folder}\n")
    assert "--trust 'evilmod:" in refusal("campaign", "resume", folder)
    assert not evil.exists()


def test_the_report_leaves_out_pictures_of_an_unknown_simulator_until_it_is_trusted(tmp_path: Path, evil: Path) -> None:
    folder = make(tmp_path / "received", CampaignConfig(**{**FINISHED.model_dump(), "siblings": ["evilmod:S"]}))
    done = ds("report", folder)
    assert done.returncode == 0 and not evil.exists() and "--trust 'evilmod:S'" in done.stderr
    assert "report without its pictures: simulator 'evilmod:S'" in done.stderr
    page = (folder / "report.html").read_text()
    assert "no picture: simulator &#39;evilmod:S&#39; is Python code" in page
    done = ds("report", folder, "--trust", "evilmod:S")
    assert done.returncode == 0 and evil.exists() and "without its pictures" not in done.stderr


def test_a_received_driver_may_hold_numbers_and_no_program(tmp_path: Path) -> None:
    for suffix in (".onnx", ".pt"):
        (tmp_path / f"net{suffix}").touch()
        (tmp_path / f"net{suffix}.yaml").write_text(f"file: net{suffix}\ninput: {{size: [160, 320]}}\n")
    onnx, program = (f"{tmp_path}/net{suffix}.yaml" for suffix in (".onnx", ".pt"))
    for name in ("autopilot", "dave2", "dave2@onnx", "weights.safetensors", onnx, f"{onnx}@openvino"):
        assert received_driver(DriverName.parse(name)) == DriverName.parse(name)
    for name in ("evilmod:D", program, f"{program}@cuda"):
        with pytest.raises(ValueError, match="must not run code: if you trust it, name it yourself with --trust"):
            received_driver(DriverName.parse(name))
        received_driver(DriverName.parse(name), confirmed=[name])


def packed(*numbers: float) -> bytes:
    return zlib.compress(struct.pack(f"<{len(numbers)}d", *numbers))


IMPOSSIBLE: dict[str, tuple[Any, ...]] = {
    "infinity": ("UPDATE executions SET fitness=9e999", "fitness: .inf, expected a finite number"),
    "a blob for text": ("UPDATE executions SET message=x'00'", "message: !!binary"),
    "text that is not UTF-8": ("UPDATE executions SET message=CAST(x'ff' AS TEXT)", "is damaged"),
    "too many steps": ("UPDATE executions SET steps=2000000000", "steps: 2000000000, expected at most 1e+06"),
    "unknown outcome": ("UPDATE executions SET outcome='WON'", "outcome: 'WON', expected one of COMPLETED"),
    "another trajectory": ("UPDATE executions SET trajectory_sha256=?", "match its stored SHA-256", "0" * 64),
    "a trajectory of NaN": (
        "UPDATE executions SET steps=0, simulated_seconds=0, steering=?, trajectory=?, trajectory_sha256=?",
        "trajectory holds NaN or infinity",
        *(packed(), packed(*[float("nan")] * 5), trajectory_sha256(np.full((1, 5), np.nan))),
    ),
    "a short trajectory": ("UPDATE executions SET trajectory=?", "trajectory does not hold", packed(0.0)),
    "another offset": ("UPDATE executions SET max_lateral_position=0.125", "max_lateral_position does not match"),
    "a bag elsewhere": ("UPDATE executions SET bag='bags/../../../etc'", "etc, expected text like"),
    "another simulator": ("UPDATE executions SET simulator='bullet' WHERE rowid=1", "not in its configuration"),
    "no test": ("DELETE FROM tests WHERE rowid=1", "a test that does not exist"),
    "another road": ("UPDATE tests SET road_id='0123456789ab'", "road_id does not match"),
    "no road": ("UPDATE tests SET road='[[1e400, 0]]'", "is damaged (the test"),
    "brackets": ("UPDATE tests SET road=?", "road is not JSON", "[" * 100_000),
    "seconds that are none": ("INSERT INTO about VALUES ('seconds search', 'long')", "expected seconds"),
    "an unknown kind of error": ("INSERT INTO errors VALUES ('a','b',0,'COMPLETED','')", "outcome: 'COMPLETED'"),
    "no configuration": ("UPDATE about SET value='[' WHERE key='config'", "is not JSON"),
    "a trigger": ("CREATE TRIGGER t AFTER INSERT ON tests BEGIN DELETE FROM about; END", "not a campaign's store"),
}
"""Statement, what is said of it, and its values."""


@pytest.mark.parametrize("what", IMPOSSIBLE)
def test_content_that_no_campaign_wrote_is_refused_in_one_line(tmp_path: Path, what: str) -> None:
    folder = make(tmp_path / "received")
    statement, reason, *values = IMPOSSIBLE[what]
    change(folder, statement, *values)
    before = content(folder)
    said = refusal("report", folder)
    assert reason in said and len(said) < 400, said
    assert content(folder) == before


@pytest.mark.parametrize("lane", ["right", "left"])
def test_a_campaign_of_an_earlier_version_is_read_as_it_is_and_rewritten_when_it_is_continued(
    tmp_path: Path, lane: Side
) -> None:
    config = FINISHED.model_copy(update={"lane": lane})
    for name in ("new", "old"):
        (tmp_path / name).mkdir()

    def in_lane(test: Test) -> Test:
        return replace(test, scenario=replace(test.scenario, road=test.road.in_lane(lane)))

    make_campaign(tmp_path / "new", config, 2, changed=in_lane).close()
    write_as_version_4(tmp_path / "new" / "campaign.sqlite", tmp_path / "old" / "campaign.sqlite")
    before = content(tmp_path / "old")

    def read(name: str) -> tuple[object, ...]:
        with closing(open_store(tmp_path / name)) as store:
            data = read_campaign(store)
            drives = [(one.trajectory_sha256, one.trajectory.tobytes(), one.outcome) for one in data.executions]
            return data.tests, drives, data.cells, data.config

    assert read("old") == read("new") and content(tmp_path / "old") == before
    assert ds("report", tmp_path / "old").returncode == 0 and content(tmp_path / "old") != before
    assert read("old") == read("new")
    with closing(sqlite3.connect(tmp_path / "old" / "campaign.sqlite")) as db:
        assert db.execute("PRAGMA user_version").fetchone() == (5,)


def test_a_trajectory_that_opens_to_gigabytes_takes_no_memory(tmp_path: Path) -> None:
    folder = make(tmp_path / "received")
    packer = zlib.compressobj(9)
    first, again = (packer.compress(bytes(2**22)) + packer.flush(zlib.Z_FULL_FLUSH) for _ in range(2))
    bomb = first + again * 255  # no block refers to the previous one
    change(folder, "UPDATE executions SET trajectory=?", bomb)
    tracemalloc.start()
    assert "does not hold" in refusal("report", folder)
    assert tracemalloc.get_traced_memory()[1] < 50_000_000
    tracemalloc.stop()


@pytest.mark.parametrize(
    "content", ["secret:x:0:0", "secret: {a: 1}\n", "- secret\n", "'secret", "siblings: [secret]\n"]
)
def test_a_goal_that_names_a_file_does_not_get_to_read_it(content: str, tmp_path: Path) -> None:
    from ds_studies.ros.goals import _config_of

    path = tmp_path / "passwd"
    path.write_text(content)
    with pytest.raises(ConfigError, match="no configuration that can be read") as refused:
        _config_of(str(path), tmp_path / "campaign", ())
    assert "secret" not in str(refused.value)


@pytest.mark.parametrize("seed", [-1, MAX_SEED + 1, 2**64, 10**400])
def test_a_seed_is_one_that_a_store_can_hold(seed: int) -> None:
    road = Road([(125.0, 25.0 * k) for k in range(5)])
    assert Scenario(road, seed=MAX_SEED).seed == MAX_SEED
    with pytest.raises(ScenarioError, match="expected a whole number from 0"):
        Scenario(road, seed=seed)
