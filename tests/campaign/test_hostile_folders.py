# SPDX-License-Identifier: Apache-2.0
"""Folders of an attacker: no verb leaves the folder, waits for a FIFO, or takes more than bounded time and memory."""

from __future__ import annotations

import json
import os
import sqlite3
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from report_campaigns import make_campaign, make_tests
from tests.campaign.test_unusable_folders import content
from tests.command_line import ds, refusal

from ds_analysis.common.outcome_table import OutcomeTableError, table_of_comparison
from ds_analysis.real.proposal import read_proposed
from ds_analysis.real.records import RecordError, read_csv, read_drives
from ds_base import folder_files
from ds_base.folder_files import StoreError, check_folder, locked, read_file
from ds_driver.networks.driver_name import AUTOPILOT
from ds_orchestrator.campaign.config import CampaignConfig, SearchConfig
from ds_orchestrator.campaign.folder import open_store, read_campaign, with_kept_engine
from ds_orchestrator.store.store import Store
from ds_road import write_roads
from ds_sim import BULLET, DONKEY, SOFTBODY
from ds_sim.testing import STRAIGHT

SEARCH = SearchConfig(population=2, iterations=2, runs=1)
CONFIG = CampaignConfig(siblings=[BULLET, SOFTBODY], twin=DONKEY, driver=AUTOPILOT, record="none", search=SEARCH)
READING: dict[str, tuple[object, ...]] = {
    "status": ("campaign", "status", "DIR"),
    "roads": ("campaign", "roads", "DIR"),
    "export": ("campaign", "export", "DIR", "--out", "OUT"),
    "maps": ("maps", "DIR"),
    "predict": ("predict", "DIR"),
    "make": ("suite", "make", "DIR", "--out", "OUT.json"),
    "compare": ("compare", "DIR", "DIR", "--out", "OUT"),
    "watch": ("watch", "DIR", "--port", "0"),
}
WRITING: dict[str, tuple[object, ...]] = {
    "resume": ("campaign", "resume", "DIR"),
    "report": ("report", "DIR"),
    "evaluate": ("evaluate", "DIR"),
    "propose": ("real", "propose", "DIR", "--drives", "1"),
    "record": ("real", "record", "DIR", "OUT.csv"),
    "update": ("real", "update", "DIR"),
}


@pytest.fixture
def campaign(tmp_path: Path) -> Path:
    """A received campaign of four tests on three simulators."""
    (tmp_path / "received").mkdir()
    make_campaign(tmp_path / "received", CONFIG, 2).close()
    return tmp_path / "received"


def command(words: tuple[object, ...], folder: Path) -> list[str]:
    out = str(folder.parent / "out")
    return [str(word).replace("DIR", str(folder)).replace("OUT", out) for word in words]


def super_journal(victim: Path) -> bytes:
    """A left-over rollback journal that names a file, which SQLite deletes at the end of the rollback."""
    magic, name = bytes.fromhex("d9d505f920a163d7"), str(victim).encode()
    header = (magic + struct.pack(">5I", 0, 1, 1, 512, 4096)).ljust(512, b"\0")
    return header + struct.pack(">I", 2**31 // 4096 + 1) + name + struct.pack(">II", len(name), sum(name)) + magic


@pytest.mark.parametrize("verb", [*READING, *WRITING])
def test_no_verb_opens_a_store_that_is_a_link(verb: str, campaign: Path) -> None:
    """SQLite takes the journals beside the file to which the link leads, and deletes what they name."""
    elsewhere, victim = campaign.parent / "elsewhere", campaign.parent / "victim"
    elsewhere.mkdir()
    victim.write_bytes(b"nothing\0")
    (campaign / "campaign.sqlite").rename(elsewhere / "campaign.sqlite")
    (elsewhere / "campaign.sqlite-journal").write_bytes(super_journal(victim))
    (campaign / "campaign.sqlite").symlink_to(elsewhere / "campaign.sqlite")
    before = content(campaign.parent)
    assert "campaign.sqlite is a link" in refusal(*command((READING | WRITING)[verb], campaign))
    assert content(campaign.parent) == before


def test_a_journal_that_names_another_file_is_not_replayed(campaign: Path) -> None:
    victim = campaign.parent / "victim"
    victim.write_bytes(b"nothing\0")
    (campaign / "campaign.sqlite-journal").write_bytes(super_journal(victim))
    assert "refers to other files" in refusal("campaign", "status", campaign) and victim.exists()


@pytest.mark.parametrize("verb", READING)
def test_no_verb_waits_for_a_fifo_or_changes_what_it_reads(verb: str, campaign: Path) -> None:
    os.mkfifo(campaign / "campaign.sqlite-wal")
    before = content(campaign)
    assert "campaign.sqlite-wal is not a regular file" in refusal(*command(READING[verb], campaign))
    assert content(campaign) == before


def link_of_folder(path: Path) -> None:
    path.symlink_to(path.parents[1] / "mine")


def link_of_file(path: Path) -> None:
    path.parent.mkdir(exist_ok=True)
    path.symlink_to(path.parents[2] / "mine" / "file")


PLANTED: dict[str, tuple[str, Callable[[Path], object]]] = {
    "a folder of results is a link": ("evaluation", link_of_folder),
    "the folder of real drives is a link": ("real", link_of_folder),
    "a result is a link": ("maps/overview.png", link_of_file),
    "a result of an update is a link": ("real/update.json", link_of_file),
    "a FIFO": (".live.json", os.mkfifo),
}


@pytest.mark.parametrize(
    ("verb", "planted"), [*((verb, next(iter(PLANTED))) for verb in WRITING), *(("report", it) for it in PLANTED)]
)
def test_no_verb_writes_out_of_the_folder(verb: str, planted: str, campaign: Path) -> None:
    (campaign.parent / "mine").mkdir()
    (campaign.parent / "mine" / "file").write_text("mine")
    name, plant = PLANTED[planted]
    plant(campaign / name)
    before = content(campaign.parent)
    assert str(campaign / name).partition("/maps")[0] in refusal(*command(WRITING[verb], campaign))
    assert content(campaign.parent) == before


@pytest.mark.parametrize(
    "name",
    ["report.html", ".lock", ".engine.json", "bags", "logs", "maps/maps.json", "evaluation/rq1.json",
     "real/round_1/README.md", "drives.sqlite-wal", "comparison.json", "tables/x.csv", "worse"],
)  # fmt: skip
def test_whoever_writes_has_looked_at_every_place(name: str, tmp_path: Path) -> None:
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    for make in (lambda path: path.symlink_to(tmp_path / "nowhere"), os.mkfifo):
        make(tmp_path / name)
        with pytest.raises(StoreError, match="remove it"), locked(tmp_path):
            pass
        (tmp_path / name).unlink()
    with locked(tmp_path):
        assert (tmp_path / ".lock").is_file()


def test_own_files_beside_a_campaign_stay_and_too_many_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "venv").symlink_to(tmp_path.parent)
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "bags").mkdir()
    for number in range(5):
        (tmp_path / "bags" / str(number)).touch()
    check_folder(tmp_path)
    monkeypatch.setattr(folder_files, "MOST_ENTRIES", 5)
    with pytest.raises(StoreError, match="more than 5 files"):
        check_folder(tmp_path)


def test_a_file_is_read_only_from_inside_and_bounded(tmp_path: Path) -> None:
    folder = tmp_path / "campaign"
    (folder / "real").mkdir(parents=True)
    with (folder / "real" / "large.json").open("wb") as file:
        file.truncate(2**34)
    (folder / "real" / "zero.json").symlink_to("/dev/zero")
    os.mkfifo(folder / "real" / "fifo.json")
    (folder / "linked").symlink_to(folder / "real")
    (folder / "real" / "good.json").write_text("[]")
    for name, words in (
        ("real/large.json", "longer than 16 MiB"),
        ("real/zero.json", "is a link"),
        ("real/fifo.json", "not a regular file"),
        ("linked/good.json", "is a link"),
    ):
        with pytest.raises(StoreError, match=words):
            read_file(folder, name)
    assert read_file(folder, "real/good.json") == b"[]"
    with pytest.raises(FileNotFoundError):
        read_file(folder, "real/none.json")
    os.mkfifo(folder / ".engine.json")
    assert with_kept_engine(folder, CONFIG) == CONFIG


DRIVE = {"test_id": "a", "failed": False, "outcome": "completed", "max_lateral_position": 0.5, "who": "x",
         "when": "2026-03-01", "source": "f.csv", "note": ""}  # fmt: skip
ROW = {"test_id": "a", "road": [[0, 0], [1, 1], [2, 2], [3, 4]], "conditions": ""}


@pytest.mark.parametrize(
    "value",
    [
        {}, [1], [{}], [[DRIVE]], [{**DRIVE, "failed": 1}], [{**DRIVE, "failed": True}], [{**DRIVE, "outcome": "won"}],
        [{**DRIVE, "max_lateral_position": 10**400}], [{**DRIVE, "max_lateral_position": "0.5"}],
        [{**DRIVE, "max_lateral_position": -1}], [{**DRIVE, "test_id": 7}], [{**DRIVE, "who": "x" * 10**6}],
        [DRIVE, {**DRIVE, "failed": True, "outcome": "failed", "max_lateral_position": None}], [DRIVE] * 300_000,
    ],
)  # fmt: skip
def test_real_drives_that_nobody_recorded_are_refused_at_once(value: object, tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    path = tmp_path / "real" / "drives.json"
    path.write_text(json.dumps(value))
    began = time.process_time()
    with pytest.raises((RecordError, StoreError)) as problem:
        read_drives(tmp_path)
    said = str(problem.value)
    assert "\n" not in said and (str(path) in said or "two outcomes" in said)
    assert time.process_time() - began < 5
    path.write_text(json.dumps([DRIVE]))
    assert read_drives(tmp_path)[0].max_lateral_position == 0.5


@pytest.mark.parametrize(
    "value",
    [
        [], {}, {"scale": 16.0}, {"scale": "16", "rounds": []}, {"scale": 10**400, "rounds": []},
        {"scale": 0, "rounds": []}, {"scale": 16.0, "rounds": [1]}, {"scale": 16.0, "rounds": [[1]]},
        {"scale": 16.0, "rounds": [[{**ROW, "test_id": ["a"]}]]},
        {"scale": 16.0, "rounds": [[{**ROW, "drawn": "yes"}]]}, {"scale": 16.0, "rounds": [[ROW]], "before": [7]},
        {"scale": 16.0, "rounds": [[ROW]], "population": ["a"] * 30_000},
        {"scale": 16.0, "rounds": [[]] * 300_000}, {"scale": 16.0, "rounds": [[ROW] * 100_000]},
    ],
)  # fmt: skip
def test_proposals_that_nobody_made_are_refused_at_once(value: object, tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    path = tmp_path / "real" / "proposal.json"
    path.write_text(json.dumps(value))
    began = time.process_time()
    with pytest.raises(RecordError, match="proposal.json cannot be read"):
        read_proposed(tmp_path)
    assert time.process_time() - began < 10
    path.write_text(json.dumps({"scale": 16.0, "rounds": [[{**ROW, "more": [1]}]]}))
    assert read_proposed(tmp_path).tests == [ROW["test_id"]]


def test_a_csv_with_a_column_twice_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "outcomes.csv"
    path.write_text("test_id,outcome,outcome,who,when\na,completed,failed,me,2026-03-01\n")
    with pytest.raises(RecordError, match="the column outcome comes twice"):
        read_csv(path, {"a": 2.0}, scale=16.0)


def test_comparisons_that_nobody_made_are_refused(tmp_path: Path) -> None:
    write_roads([STRAIGHT], tmp_path / "roads.json")
    row = {"road_id": STRAIGHT.road_id, "failed": {"a": False}, "max_lateral_position": {"a": 0.1}}

    def write(rows: list[Any]) -> None:
        (tmp_path / "comparison.json").write_text(json.dumps({"outcomes": rows, "simulators": ["a"]}))

    write([row])
    assert len(table_of_comparison(tmp_path)) == 1
    wrong = [[{**row, "max_lateral_position": {"a": value}}] for value in (10**400, float("nan"), -1.0)]
    for rows in (*wrong, [row] * 30_000):
        write(rows)
        with pytest.raises(OutcomeTableError, match="holds no comparison"):
            table_of_comparison(tmp_path)


@pytest.mark.parametrize("verb", [verb for verb in WRITING if verb != "resume"])
def test_what_writes_waits_for_a_running_campaign(verb: str, campaign: Path) -> None:
    before = content(campaign)
    with locked(campaign):
        said = refusal(*command(WRITING[verb], campaign), status=1)
    assert "is in use by another run: wait for it" in said
    assert content(campaign) == before


def test_what_is_read_beside_a_running_campaign_is_of_one_moment(tmp_path: Path) -> None:
    writer = make_campaign(tmp_path, CONFIG, 1)
    reader = open_store(tmp_path)
    assert len(reader.tests()) == 2
    test, executions = make_tests(CONFIG, 2)[-1]
    writer.add_test(test)
    writer.add_execution(executions[0])
    data = read_campaign(reader)
    assert len(data.tests) == 2 and len(data.executions) == 6 and reader.count_executions() == 6
    reader.close()
    writer.close()
    reader = open_store(tmp_path)  # nobody writes: SQLite reads the file as one that never changes
    assert len(reader.tests()) == 3
    with sqlite3.connect(tmp_path / "campaign.sqlite") as db:
        db.execute("DELETE FROM errors")
        db.execute("UPDATE tests SET seed = 5")
    db.close()
    with pytest.raises(StoreError, match="writes .* at this moment: wait for it"):
        reader.tests()
    reader.close()


def test_a_copy_that_sqlite_made_is_read_while_it_is_continued(campaign: Path, tmp_path: Path) -> None:
    """VACUUM INTO leaves out the write-ahead log, without which a writer turns readers away."""
    copy = tmp_path / "copy" / "campaign.sqlite"
    copy.parent.mkdir()
    db = sqlite3.connect(campaign / "campaign.sqlite")
    db.execute("VACUUM INTO ?", (str(copy),))
    db.close()
    writer = Store(copy, config=Store(copy, read_only=True).config)
    reader = Store(copy, read_only=True)
    writer.note("new", "fact")
    assert len(reader.tests()) == 4
    reader.close()
    writer.close()


def test_a_name_that_is_no_text_gets_one_line(tmp_path: Path) -> None:
    folder = tmp_path / os.fsdecode(b"caf\xe9")
    folder.mkdir()
    make_campaign(folder, CONFIG, 1).close()
    before = content(tmp_path)
    for words in (*READING.values(), *WRITING.values()):
        assert "not UTF-8" in refusal(*command(words, folder)), words
    assert content(tmp_path) == before


def test_a_store_that_is_only_read_keeps_its_bytes_and_its_folder(campaign: Path) -> None:
    before = content(campaign)
    for verb in ("status", "roads", "export", "maps", "make"):
        assert ds(*command(READING[verb], campaign)).returncode == 0, verb
    assert content(campaign) == before and not (campaign / ".lock").exists()
    assert len(Store(campaign / "campaign.sqlite", read_only=True).tests()) == 4


BUDGET = 100
_INSIDE = """
import sys
from ds_cli.main import main
try:
    main()
finally:
    print(next(line for line in open("/proc/self/status") if line.startswith("VmHWM")), file=sys.stderr)
"""
"""Runs `ds`; its last line tells the most memory that the process held, kB, that of its parent left out."""


def large_campaign(folder: Path, runs: int) -> Path:
    """Create a finished campaign whose executions are copies of a few."""
    folder.mkdir()
    search = SearchConfig(population=BUDGET, iterations=0, runs=runs)
    config = CampaignConfig(siblings=[BULLET, SOFTBODY], twin=DONKEY, driver=AUTOPILOT, search=search)
    make_campaign(folder, config, 1).close()
    count = f"WITH n(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM n WHERE n < {runs * BUDGET - 1}) "
    test_id = f"printf('%s-%d-%04d', sibling, n / {BUDGET}, n % {BUDGET})"
    with closing(sqlite3.connect(folder / "campaign.sqlite")) as db, db:
        db.execute(
            f"INSERT INTO executions {count} SELECT {test_id}, simulator, outcome, message, fitness, "
            "max_lateral_position, steps, simulated_seconds, trajectory_sha256, bag, trajectory, steering "
            "FROM n, executions JOIN tests USING (test_id)"
        )
        db.execute(
            f"INSERT INTO tests {count} SELECT {test_id}, sibling, n / {BUDGET}, n % {BUDGET}, road, road_id, "
            "turns_count, curvature, seed, conditions FROM n, tests"
        )
    return folder


def memory(*arguments: str | Path) -> float:
    """Run `ds`, and return the most memory that it held, MB."""
    command = [sys.executable, "-c", _INSIDE, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"})
    assert done.returncode == 0, done.stderr
    return int(done.stderr.split()[-2]) / 1024


@pytest.mark.parametrize(("verb", "most"), [(("campaign", "status"), 8.0), (("maps",), 60.0)])
def test_memory_of_a_verb_on_20_000_executions(tmp_path: Path, verb: tuple[str, ...], most: float) -> None:
    few, many = large_campaign(tmp_path / "few", 1), large_campaign(tmp_path / "many", 34)
    assert memory(*verb, many, "--json") - memory(*verb, few, "--json") < most
