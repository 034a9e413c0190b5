# SPDX-License-Identifier: Apache-2.0
"""All packages have the same version and install their type information."""

from __future__ import annotations

import re
import tomllib
import xml.etree.ElementTree as ElementTree
from distutils.core import run_setup  # setuptools provides it where Python no longer does
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
PYTHON_PACKAGES = sorted(setup.parent for setup in ROOT.glob("src/*/setup.py"))


def distribution_of(package: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Read a package's setup.py from its own folder, as colcon does, without building anything."""
    monkeypatch.chdir(package)
    return run_setup("setup.py", script_args=["--quiet", "build_py"], stop_after="commandline")


@pytest.mark.parametrize("package", PYTHON_PACKAGES, ids=lambda package: package.name)
def test_setup_installs_type_information_under_what_the_manifest_says(
    package: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    distribution = distribution_of(package, monkeypatch)
    manifest = ElementTree.parse(package / "package.xml").getroot()
    said = {
        key: getattr(distribution.metadata, key) for key in ("name", "version", "description", "license", "maintainer")
    }
    assert said == {key: manifest.findtext(key) for key in said}
    assert [entry.get("email") for entry in manifest.iter("maintainer")] == [distribution.metadata.maintainer_email]
    assert distribution.extras_require == {"test": ["pytest"]}  # colcon runs pytest for these, else unittest
    command = distribution.get_command_obj("build_py")
    command.ensure_finalized()
    installed = {(Path(folder) / name).as_posix() for _, folder, _, names in command.data_files for name in names}
    assert f"{package.name}/py.typed" in installed
    stubs = {path.relative_to(package).as_posix() for path in package.glob("ds_*/**/*.pyi")}
    assert stubs <= installed


def test_a_release_finds_every_place_of_the_version() -> None:
    """As `bump-my-version` searches them: once in each file. It writes a file only where it found the text."""
    release = tomllib.loads((ROOT / ".bumpversion.toml").read_text())["tool"]["bumpversion"]
    assert release["current_version"] == VERSION
    places, nothing_to_release = 0, f"\n## [Unreleased]\n\n## [{VERSION}]"
    for place in release["files"]:
        wanted = place["search"].format(current_version=VERSION)
        pattern = wanted if place.get("regex") else re.escape(wanted)
        files = sorted(ROOT.glob(place.get("glob") or place["filename"]))
        texts = [file.read_text() for file in files]
        assert texts and all(len(re.findall(pattern, text)) == 1 or nothing_to_release in text for text in texts), place
        places += len(files)
    assert places >= 2 * len(PYTHON_PACKAGES) + 7


def test_actions_of_workflows_are_pinned_by_commit() -> None:
    files = [ROOT / "action.yml", *ROOT.glob(".github/workflows/*.yml")]
    used = [line for file in files for line in file.read_text().splitlines() if re.search(r"uses: [\w-]+/", line)]
    assert len(used) >= 6 and all(re.search(r"@[0-9a-f]{40}  # v\d", line) for line in used)


def test_the_changelog_begins_with_the_version_of_the_project() -> None:
    headings = [line for line in (ROOT / "CHANGELOG.md").read_text().splitlines() if line.startswith("## ")]
    released = [heading for heading in headings if heading != "## [Unreleased]"]
    assert released[0].startswith(f"## [{VERSION}] - ")
