# SPDX-License-Identifier: Apache-2.0
"""Parts that an installed package adds by its entry points."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from ds_base.extension import ExtensionError, installed, load_installed


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A package on the path, with one operator that is a number, one that is a text, and one that is missing."""
    (tmp_path / "more_parts.py").write_text("NUMBER, TEXT = 4, 'four'\n")
    about = tmp_path / "more_parts-1.2.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: more-parts\nVersion: 1.2\n")
    lines = (f"{name} = more_parts:{name.upper()}\n" for name in ("number", "text", "missing"))
    (about / "entry_points.txt").write_text("[digital_siblings.operators]\n" + "".join(lines))
    monkeypatch.syspath_prepend(tmp_path)
    installed.cache_clear()
    yield
    installed.cache_clear()


@pytest.mark.usefixtures("package")
def test_a_part_of_an_installed_package_is_listed_with_its_package_and_loaded() -> None:
    entry = installed("operators")["number"]
    assert entry.dist is not None and (entry.dist.name, entry.dist.version) == ("more-parts", "1.2")
    assert load_installed("number", "operators", int, "operator") == 4
    assert "number" not in installed("features")


@pytest.mark.usefixtures("package")
@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("text", "operator text is a str, expected a int"),
        ("missing", r"operator missing cannot be imported \(AttributeError: .*\): install more-parts again"),
    ],
)
def test_a_part_that_is_none_is_named(name: str, told: str) -> None:
    with pytest.raises(ExtensionError, match=told):
        load_installed(name, "operators", int, "operator")
