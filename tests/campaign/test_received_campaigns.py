# SPDX-License-Identifier: Apache-2.0
"""Received campaign folders: they run no code, and content that no campaign writes is refused."""

from __future__ import annotations

import sqlite3
import struct
import sys
import zlib
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from report_campaigns import make_campaign, make_tests
from tests.campaign.damaged_stores import change_store, write_as_version_4
from tests.campaign.test_hostile_folders import super_journal
from tests.campaign.test_unusable_folders import content
from tests.command_line import ds, refusal

from ds_driver.networks.driver_name import AUTOPILOT, DriverName, received_driver
from ds_orchestrator.campaign.config import CampaignConfig, ConfigError, SearchConfig
from ds_orchestrator.campaign.folder import open_store, read_campaign
from ds_orchestrator.store.rows import trajectory_sha256
from ds_orchestrator.store.store import Store
from ds_road import Road, Side
from ds_sim import DONKEY
from ds_sim.scenario import MAX_SEED, Scenario, ScenarioError

SEARCH = SearchConfig(population=1, iterations=1, runs=1)
CONFIG = CampaignConfig(siblings=[DONKEY], twin=None, driver=AUTOPILOT, record="none", search=SEARCH)


def make(folder: Path, config: CampaignConfig = CONFIG) -> Path:
    """Create a finished campaign of two tests."""
    folder.mkdir()
    make_campaign(folder, config, 2).close()
    return folder


def change(folder: Path, statement: str, *values: object) -> None:
    change_store(folder / "campaign.sqlite", statement, *values)


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
    config = CampaignConfig.model_validate({**CONFIG.model_dump(), **received})
    folder = make(tmp_path / "received", config)
    for verb, following in ((("campaign", "status"), "campaign resume"), (("maps",), "report")):
        done = ds(*verb, folder)
        assert (done.returncode, done.stderr) == (0, f"next: ds {following} {folder}\n")
    assert "--trust 'evilmod:" in refusal("campaign", "resume", folder)
    assert not evil.exists()


def test_the_report_leaves_out_pictures_of_an_unknown_simulator_until_it_is_trusted(tmp_path: Path, evil: Path) -> None:
    folder = make(tmp_path / "received", CampaignConfig(**{**CONFIG.model_dump(), "siblings": ["evilmod:S"]}))
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
    config = CONFIG.model_copy(update={"lane": lane})
    (tmp_path / "new").mkdir()
    with closing(Store(tmp_path / "new" / "campaign.sqlite", config=config.identity())) as store:
        for test, executions in make_tests(config, 2):
            scenario = replace(test.scenario, road=test.road.in_lane(lane))
            store.add_test(replace(test, scenario=scenario))
            for execution in executions:
                store.add_execution(execution)
    (tmp_path / "old").mkdir()
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
    import tracemalloc

    folder = make(tmp_path / "received")
    packer = zlib.compressobj(9)
    first, again = (packer.compress(bytes(2**22)) + packer.flush(zlib.Z_FULL_FLUSH) for _ in range(2))
    bomb = first + again * 255  # no block refers to the previous one
    change(folder, "UPDATE executions SET trajectory=?", bomb)
    tracemalloc.start()
    assert "does not hold" in refusal("report", folder)
    assert tracemalloc.get_traced_memory()[1] < 50_000_000
    tracemalloc.stop()


def test_a_journal_that_names_another_file_is_not_replayed(tmp_path: Path) -> None:
    """SQLite deletes the file that a left-over rollback journal names as its super-journal."""
    folder = make(tmp_path / "received")
    victim = tmp_path / "victim"
    victim.write_bytes(b"nothing\0")
    (folder / "campaign.sqlite-journal").write_bytes(super_journal(victim))
    assert "refers to other files" in refusal("campaign", "status", folder) and victim.exists()


@pytest.mark.parametrize(
    "content", ["secret:x:0:0", "secret: {a: 1}\n", "- secret\n", "'secret", "siblings: [secret]\n"]
)
def test_a_goal_that_names_a_file_does_not_get_to_read_it(content: str, tmp_path: Path) -> None:
    from ds_studies.ros.orchestrator_node import _config_of

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
