# SPDX-License-Identifier: Apache-2.0
"""Tubs of Donkey Car 5, as tests of several packages need them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any


def write_tub(folder: Path, rows: Sequence[Mapping[str, Any]], *, deleted: Sequence[int] = ()) -> Path:
    """Write a manifest and one catalog; row k has the index k, and the time 1000 + 50 k ms unless it names its own."""
    folder.mkdir(parents=True, exist_ok=True)
    last = json.dumps({"paths": ["catalog_0.catalog"], "deleted_indexes": [*deleted]})
    (folder / "manifest.json").write_text("\n".join(["[]", "[]", "{}", "{}", last]))
    lines = [json.dumps({"_index": k, "_timestamp_ms": 1000 + 50 * k, **row}) for k, row in enumerate(rows)]
    (folder / "catalog_0.catalog").write_text("\n".join(lines))
    return folder
