# SPDX-License-Identifier: Apache-2.0
"""A release from one command, in a repository of the files that name the version."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tomllib
import xml.etree.ElementTree as ElementTree
from datetime import UTC, datetime
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FILES = (
    "pyproject.toml",
    "CITATION.cff",
    "tools/release.py",
    "src/*/package.xml",
    "src/*/setup.cfg",
    "examples/ci/*.yml",
)
CHANGELOG = """\
# Changelog

## [Unreleased]

### Added
- `ds fly`.

## [0.2.0] - 2026-11-22

### Fixed
- Brakes.
"""


def git(folder: Path, *arguments: str) -> str:
    return subprocess.run(
        ["git", "-C", folder, *arguments], check=True, capture_output=True, text=True, timeout=60
    ).stdout


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    for file in (file for pattern in FILES for file in ROOT.glob(pattern)):
        (tmp_path / file.relative_to(ROOT)).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(file, tmp_path / file.relative_to(ROOT))
    (tmp_path / "CHANGELOG.md").write_text(CHANGELOG)
    git(tmp_path, "init", "--quiet")
    for key, value in (("user.name", "Test"), ("user.email", "test@example.invalid")):
        git(tmp_path, "config", key, value)
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "--quiet", "-m", "Start")
    return tmp_path


def release(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    words = [sys.executable, str(folder / "tools/release.py"), *arguments]
    return subprocess.run(words, capture_output=True, text=True, timeout=60)


def test_a_release_is_one_commit_with_an_annotated_tag(repository: Path) -> None:
    today = f"{datetime.now(UTC):%Y-%m-%d}"
    done = release(repository, "9.10.11")
    assert done.returncode == 0, done.stderr
    assert git(repository, "status", "--porcelain") == ""
    assert git(repository, "log", "-1", "--format=%s") == "Release 9.10.11\n"
    assert git(repository, "describe", "--exact-match") == "v9.10.11\n"  # annotated tags only
    message = git(repository, "tag", "--list", "--format=%(contents)", "v9.10.11")
    assert "### Added\n- `ds fly`." in message and "Brakes" not in message

    assert tomllib.loads((repository / "pyproject.toml").read_text())["project"]["version"] == "9.10.11"
    manifests = sorted(repository.glob("src/*/package.xml"))
    assert len(manifests) == len(list(ROOT.glob("src/*/package.xml")))
    assert {ElementTree.parse(file).findtext("version") for file in manifests} == {"9.10.11"}
    configurations = sorted(repository.glob("src/*/setup.cfg"))
    assert all(file.read_text().count("\nversion = 9.10.11\n") == 1 for file in configurations) and configurations
    citation = (repository / "CITATION.cff").read_text()
    assert "\nversion: 9.10.11\n" in citation and f"\ndate-released: {today}\n" in citation
    assert citation.startswith("cff-version: 1.2.0\n")
    for example in repository.glob("examples/ci/*.yml"):
        assert re.findall(r"VERSION: (v\S+)", example.read_text()) == ["v9.10.11"]
    new = CHANGELOG.replace("## [Unreleased]\n", f"## [Unreleased]\n\n## [9.10.11] - {today}\n")
    assert (repository / "CHANGELOG.md").read_text() == new

    again = release(repository, "9.10.12")
    assert again.returncode == 2 and "nothing under [Unreleased]" in again.stderr


@pytest.mark.parametrize(
    ("version", "why"),
    [
        ("0.2.0", "expected a version after 0.2.0"),
        ("0.10", "expected a version after 0.2.0"),
        ("v0.3.0", "expected a version after 0.2.0"),
        ("--help", "expected one version"),
    ],
)
def test_a_version_that_cannot_follow_is_refused(repository: Path, version: str, why: str) -> None:
    done = release(repository, version)
    assert done.returncode == 2 and why in done.stderr and len(done.stderr.splitlines()) == 1
    assert git(repository, "log", "--format=%s") == "Start\n"


def test_nothing_is_written_where_a_file_is_changed_or_the_tag_exists(repository: Path) -> None:
    git(repository, "tag", "v0.3.0")
    assert "the tag v0.3.0 exists" in release(repository, "0.3.0").stderr
    with (repository / "CITATION.cff").open("a") as citation:
        citation.write("# changed\n")
    assert "commit them first" in release(repository, "0.4.0").stderr
    assert git(repository, "status", "--porcelain") == " M CITATION.cff\n"


def test_a_file_without_its_version_is_named_and_nothing_is_written(repository: Path) -> None:
    citation = repository / "CITATION.cff"
    citation.write_text(citation.read_text().replace("date-released", "released"))
    git(repository, "commit", "--quiet", "--all", "-m", "Break")
    done = release(repository, "0.3.0")
    assert done.returncode == 2 and done.stderr.startswith("no release: CITATION.cff: expected one line like")
    assert git(repository, "status", "--porcelain") == ""
