#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Make a release: write its version everywhere, date its section of the changelog, commit and tag.

Usage: python tools/release.py 0.3.0
"""

from __future__ import annotations

import re
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
RELEASED = re.compile(r"^## \[(\d+)\.(\d+)\.(\d+)\]", re.MULTILINE)
UNRELEASED = re.compile(r"^## \[Unreleased\]\n+(.*?)(?=^## |\Z)", re.MULTILINE | re.DOTALL)
PLACES = (
    ("pyproject.toml", r'^version = ".*"$', 'version = "{version}"'),
    ("src/*/setup.cfg", r"^version = .*$", "version = {version}"),
    ("src/*/package.xml", r"<version>.*</version>", "<version>{version}</version>"),
    ("examples/ci/*.yml", r"DIGITAL_SIBLINGS_VERSION: v\S+", "DIGITAL_SIBLINGS_VERSION: v{version}"),
    ("CITATION.cff", r"^version: .*$", "version: {version}"),
    ("CITATION.cff", r"^date-released: .*$", "date-released: {date}"),
    ("CHANGELOG.md", r"^## \[Unreleased\]$", "## [Unreleased]\n\n## [{version}] - {date}"),
)
"""Files, the one place in each, and what it becomes."""


class ReleaseError(Exception):
    """Release that cannot be made; the text is one line that says why and what to do."""


def git(*arguments: str) -> str:
    """Run git in the project's root; the result is its standard output."""
    done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, timeout=60)
    if done.returncode:
        reason = (done.stderr or done.stdout).strip().splitlines()
        raise ReleaseError(f"git {arguments[0]} failed: {reason[-1] if reason else done.returncode}")
    return done.stdout


def notes_of(version: str) -> str:
    """Return the changelog's unreleased section.

    Raises:
        ReleaseError: the version is not one, or not later than the last one; there is nothing to release; files are
            changed; or the tag exists.
    """
    changelog = (ROOT / "CHANGELOG.md").read_text()
    last = max((tuple(map(int, numbers)) for numbers in RELEASED.findall(changelog)), default=(0, 0, 0))
    if not re.fullmatch(r"(0|[1-9]\d*)(\.(0|[1-9]\d*)){2}", version) or tuple(map(int, version.split("."))) <= last:
        raise ReleaseError(f"{version}: expected a version after {'.'.join(map(str, last))}, such as 1.2.3")
    section = UNRELEASED.search(changelog)
    if section is None or not section[1].strip():
        raise ReleaseError("CHANGELOG.md has nothing under [Unreleased]: write there what a user notices")
    if git("status", "--porcelain", "--untracked-files=no"):
        raise ReleaseError("files are changed: commit them first")
    if git("tag", "--list", f"v{version}"):
        raise ReleaseError(f"the tag v{version} exists: choose a later version")
    return section[1].strip()


def edited(version: str, date: str) -> dict[Path, str]:
    """Map each file that names the version to its new text.

    Raises:
        ReleaseError: a file does not have its place exactly once.
    """
    texts: dict[Path, str] = {}
    for pattern, place, new in PLACES:
        for file in sorted(ROOT.glob(pattern)):
            line = new.format(version=version, date=date)
            texts[file], count = re.subn(place, lambda _: line, texts.get(file, file.read_text()), flags=re.MULTILINE)  # noqa: B023
            if count != 1:
                raise ReleaseError(f"{file.relative_to(ROOT)}: expected one line like {place}, found {count}")
    return texts


def main() -> int:
    """Make the release that the arguments ask for; the result is the exit status."""
    if len(sys.argv) != 2 or sys.argv[1].startswith("-"):
        print("expected one version: python tools/release.py 0.3.0", file=sys.stderr)
        return 2
    version = sys.argv[1]
    try:
        notes = notes_of(version)
        for file, text in edited(version, f"{datetime.now(UTC):%Y-%m-%d}").items():
            file.write_text(text)
        git("commit", "--quiet", "--all", "--message", f"Release {version}")
        git("tag", "--annotate", f"v{version}", "--cleanup=verbatim", "--message", f"Version {version}\n\n{notes}\n")
    except ReleaseError as error:
        print(f"no release: {error}", file=sys.stderr)
        return 2
    print(f"Committed and tagged v{version}. To publish it: git push --follow-tags")
    return 0


if __name__ == "__main__":
    sys.exit(main())
