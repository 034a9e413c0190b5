# SPDX-License-Identifier: Apache-2.0
"""Subjects of commits are checked in a hook, in a clone, and not where there is no history."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

TOOL = Path(__file__).resolve().parents[1] / "tools/check_subjects.py"
GOOD = "Refuse roads of infinite points"


def check(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, TOOL, *arguments], cwd=folder, capture_output=True, text=True, timeout=60)


@pytest.mark.parametrize(
    ("subject", "fault"),
    [
        ("x" * 72, None),
        ("ü" * 72, None),
        ("Split A/B into two, and/or three", None),
        ("Read DIR/campaign.sqlite once", None),
        ("x" * 73, "is longer than 72 characters"),
        ("Refuse roads.", "ends with a full stop"),
        ("Read /tmp/roads first", "names an absolute path"),
        ("Keep drives in ~/drives", "names an absolute path"),
        ("", "is empty"),
    ],
)
def test_a_hook_refuses_a_bad_subject(tmp_path: Path, subject: str, fault: str | None) -> None:
    (tmp_path / "message").write_text(f"{subject}\n\nA body with /any/path, however long it may be." + "x" * 100)
    done = check(tmp_path, "message")
    assert done.returncode == (fault is not None)
    assert fault is None or f"message: the subject {fault}" in done.stdout


def test_new_commits_are_checked_also_in_a_detached_clone_of_depth_one(tmp_path: Path) -> None:
    def git(folder: Path, *arguments: str) -> None:
        identity = ["-c", "user.name=Test", "-c", "user.email=test@example.invalid"]
        subprocess.run(["git", *identity, *arguments], cwd=folder, check=True, capture_output=True, timeout=60)

    source = tmp_path / "source"
    source.mkdir()
    git(source, "init", "--quiet")
    for subject in ("Start.", GOOD):
        git(source, "commit", "--quiet", "--allow-empty", "-m", subject)
    assert check(source).returncode == 1
    assert check(source, "HEAD~1..HEAD").returncode == 0

    git(tmp_path, "clone", "--quiet", "--depth", "1", source.as_uri(), "clone")
    git(tmp_path / "clone", "checkout", "--quiet", "--detach")
    shallow = check(tmp_path / "clone")
    assert (shallow.returncode, shallow.stdout) == (0, "subjects of commits: 1 checked\n")
    absent = check(tmp_path / "clone", "HEAD~1..HEAD")
    assert absent.returncode == 0 and "not checked" in absent.stdout


def test_an_export_without_history_is_not_checked(tmp_path: Path) -> None:
    done = check(tmp_path)
    assert done.returncode == 0 and "not checked" in done.stdout
