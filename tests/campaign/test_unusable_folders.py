# SPDX-License-Identifier: Apache-2.0
"""Unusable folders: one clear line, a non-zero exit status, and no byte changed."""

from __future__ import annotations

import hashlib
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from tests.campaign.engines import MadeUpEngine
from tests.campaign.test_campaign import run
from tests.command_line import ds, refusal

from ds_base.folder_files import StoreError, locked
from ds_orchestrator.campaign.config import read_config
from ds_orchestrator.store.store import Store

CONFIG = """
siblings: [donkey]
twin: null
driver: autopilot
seed: 7
record: {record}
search: {{population: 2, iterations: 2, runs: 1, min_angle: 40, max_angle: 90}}
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
    path.write_text(CONFIG.format(record="none"))
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


def change(folder: Path, statement: str) -> None:
    db = sqlite3.connect(folder / "campaign.sqlite", isolation_level=None)
    db.execute(statement)
    db.close()


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
