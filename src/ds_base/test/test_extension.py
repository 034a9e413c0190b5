# SPDX-License-Identifier: Apache-2.0
"""What is installed: parts that a package adds by its entry points, and messages that are shared."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from installed_package import installed_package

from ds_base.extension import ExtensionError, installed, load_installed
from ds_base.installation import share_folders


@pytest.fixture
def package(tmp_path: Path) -> Iterator[None]:
    """A package on the path, with one operator that is a number, one that is a text, and one that is missing."""
    (tmp_path / "more_parts.py").write_text("NUMBER, TEXT = 4, 'four'\n")
    operators = {name: f"more_parts:{name.upper()}" for name in ("number", "text", "missing")}
    with installed_package(tmp_path, "operators", operators):
        yield


@pytest.mark.usefixtures("package")
def test_a_part_of_an_installed_package_is_listed_with_its_package_and_loaded() -> None:
    entry = installed("operators")["number"]
    assert entry.dist is not None and (entry.dist.name, entry.dist.version) == ("theirs", "1.2")
    assert load_installed("number", "operators", int, "operator") == 4
    assert "number" not in installed("features")


@pytest.mark.usefixtures("package")
@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("text", "operator text is a str, expected a int"),
        ("missing", r"operator missing cannot be imported \(AttributeError: .*\): install theirs again"),
    ],
)
def test_a_part_that_is_none_is_named(name: str, told: str) -> None:
    with pytest.raises(ExtensionError, match=told):
        load_installed(name, "operators", int, "operator")


def test_a_checkout_without_a_workspace_has_its_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    assert any((folder / "msg/Road.msg").is_file() for folder in share_folders("ds_interfaces"))
