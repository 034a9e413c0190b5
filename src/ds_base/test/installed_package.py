# SPDX-License-Identifier: Apache-2.0
"""Packages that add parts by their entry points, as if pip had installed them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import pytest

from ds_base.extension import installed


def write_package(folder: Path, kind: str, parts: Mapping[str, str]) -> None:
    """Write what pip leaves of the package `theirs` 1.2, whose parts of a kind are at these places."""
    about = folder / "theirs-1.2.dist-info"
    about.mkdir(exist_ok=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: theirs\nVersion: 1.2\n")
    lines = [f"[digital_siblings.{kind}]", *(f"{name} = {place}" for name, place in parts.items())]
    with (about / "entry_points.txt").open("a") as file:
        file.write("\n".join([*lines, ""]))


@contextmanager
def installed_package(folder: Path, kind: str, parts: Mapping[str, str]) -> Iterator[None]:
    """Have the package on the path, and none of it known afterwards."""
    write_package(folder, kind, parts)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        installed.cache_clear()
        yield
    installed.cache_clear()
