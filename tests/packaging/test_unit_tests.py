# SPDX-License-Identifier: Apache-2.0
"""Unit tests run after a plain `make setup`, without the libraries that only `make test` installs."""

from __future__ import annotations

import ast
import re
import sys
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = sorted(ROOT.glob("src/*/test"))


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def pins(name: str) -> set[str]:
    lines = (line.partition("#")[0].strip() for line in (ROOT / f"requirements/{name}.txt").read_text().splitlines())
    return {normal(re.split(r"==", line)[0]) for line in lines if line}


def imports_when_collected(file: Path) -> set[str]:
    """List the top-level modules that a file imports outside of functions and of `if TYPE_CHECKING`."""
    found: set[str] = set()
    for node in ast.parse(file.read_text()).body:
        if isinstance(node, ast.Import):
            found |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found.add(node.module.partition(".")[0])
    return found - set(sys.stdlib_module_names)


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.parent.name)
def test_files_are_collected_with_what_plain_set_up_installs(folder: Path) -> None:
    plain = pins("build") | pins("ros") | pins("project")
    distributions = packages_distributions()
    files = sorted(folder.rglob("*.py"))
    own = {path.stem for path in ROOT.glob("src/*/test/**/*.py")} | {path.name for path in ROOT.glob("src/*/ds_*")}
    missing = {
        f"{file.name}: {module}"
        for file in files
        for module in imports_when_collected(file) - own
        if not plain & {normal(name) for name in distributions.get(module, [])}
    }
    assert files and not missing, f"use pytest.importorskip: {sorted(missing)}"
