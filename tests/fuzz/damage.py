# SPDX-License-Identifier: Apache-2.0
"""Seeded damage: to bytes, and to the values of JSON and YAML documents."""

from __future__ import annotations

import copy
import json
import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

Rng = np.random.Generator

STRANGE: Sequence[Any] = (
    None, True, False, 0, -1, 1, 2**31, -(2**31) - 1, 2**63, 2**64, 10**30, 10**400, -(10**400), 1e308, -1e-320,
    math.nan, math.inf, -math.inf, 0.5, "", " ", "0", "-1", "nan", "inf", "1e999", "9" * 400, "9" * 5000, "x" * 10_000,
    "a\nb", "\x00", "\x7f\x1b[31m", "ü", "\U0001f697", "../x", "../../etc/passwd", "/tmp/x", "/dev/zero", ".", "..",
    "a/b", "a\\b", "evilmod:S", "donkey@/dev/zero", "donkey@none.yaml", "bullet@x", [], {}, [[]], [None], {"": None},
    {"a": {"b": {"c": 1}}}, [1, 2, 3], ["a"] * 50, [[0.0, 0.0]] * 5, "[[0,0],[1,1],[2,2],[3,3]]", "{}", "[1e400]",
)  # fmt: skip
"""Values that often break programs."""


BRACKETS = b"[" * 200_000
ALIASES = b"z0: &z0 [lol]\n" + b"".join(
    b"z%d: &z%d [%s]\n" % (i, i, b", ".join([b"*z%d" % (i - 1)] * 9)) for i in range(1, 10)
)
"""YAML whose aliases expand to billions of values."""
NO_FILE: dict[str, Callable[[Path], object]] = {
    "a folder": Path.mkdir,
    "an empty file": Path.touch,
    "a FIFO": os.mkfifo,
    "a device": lambda path: path.symlink_to("/dev/zero"),
    "a dangling link": lambda path: path.symlink_to("none"),
    "nothing": lambda path: None,
}
"""What may stand in a file's place."""


def _write_16_gib(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(2**34)


HOSTILE: dict[str, Callable[[Path], object]] = {
    **NO_FILE,
    "16 GiB": _write_16_gib,
    "20 MB of YAML": lambda path: path.write_bytes(b"a: b\n" * 4_000_000),
    "brackets": lambda path: path.write_bytes(BRACKETS),
    "aliases": lambda path: path.write_bytes(ALIASES),
    "no text": lambda path: path.write_bytes(b"\xff\xfe\x00"),
}
"""The same, and content that takes a careless reader endless time or memory."""


def damaged_bytes(data: bytes, rng: Rng) -> bytes:
    """Apply one to four changes to bytes: flips, cuts, splices, repeats, and overwriting with extreme numbers."""
    made = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):
        if not made:
            break
        at = int(rng.integers(len(made)))
        size = min(len(made) - at, 2 ** int(rng.integers(12)))
        match int(rng.integers(9)):
            case 0 | 1:
                made[at] ^= 1 << int(rng.integers(8))
            case 2:
                made[at : at + size] = rng.bytes(size)
            case 3:
                del made[at:]
            case 4:
                del made[at : at + size]
            case 5:
                made[at:at] = made[at : at + size] * int(rng.integers(1, 4))
            case 6:
                other = int(rng.integers(len(made)))
                made[at : at + size] = made[other : other + size]
            case 7:
                width = int(rng.choice([1, 2, 4, 8]))
                number = [0, 1, 2 ** (8 * width - 1) - 1, 2 ** (8 * width - 1), 2 ** (4 * width)][int(rng.integers(5))]
                made[at : at + width] = number.to_bytes(width, "little")
            case 8:
                made[at : at + size] = bytes([255 * int(rng.integers(2))]) * size
    return bytes(made)


def damaged_value(value: Any, rng: Rng) -> Any:
    """Apply one to three changes to a JSON value: another type, a missing or extra entry, an extreme number."""
    made = copy.deepcopy(value)
    for _ in range(int(rng.integers(1, 4))):
        made = _changed(made, rng)
    return made


def _changed(value: Any, rng: Rng) -> Any:
    keys = list(value) if isinstance(value, dict) else list(range(len(value))) if isinstance(value, list) else []
    if not keys or rng.random() < 0.1:
        return _other(value, rng)
    key = keys[int(rng.integers(len(keys)))]
    if rng.random() < 0.75:
        value[key] = _changed(value[key], rng)
    elif rng.random() < 0.5:
        del value[key]
    elif isinstance(value, list):
        value[int(key) : int(key)] = [copy.deepcopy(value[key])] * int(rng.integers(1, 4))
    else:
        value[_strange(rng) if rng.random() < 0.5 else f"{key}x"] = value.pop(key)
    return value


def _strange(rng: Rng) -> Any:
    found = STRANGE[int(rng.integers(len(STRANGE)))]
    return found if isinstance(found, str) else str(found)[:40]


def _other(value: Any, rng: Rng) -> Any:
    """Return an unusual value, or the value as another type."""
    if rng.random() < 0.7:
        return copy.deepcopy(STRANGE[int(rng.integers(len(STRANGE)))])
    if rng.random() < 0.3:
        for _ in range([3, 60, 150][int(rng.integers(3))]):
            value = [value]
        return value
    turns: Sequence[Callable[[Any], Any]] = (str, lambda v: [v], lambda v: {"x": v}, repr, lambda v: [v, v])
    return turns[int(rng.integers(len(turns)))](value)


def damaged_json(text: str, rng: Rng) -> bytes:
    """Damage a JSON document, or one line of JSON Lines: mostly its values, else its bytes."""
    lines = text.splitlines()
    if len(lines) > 1 and not lines[0].rstrip().endswith(("{", "[", ",")):
        at = int(rng.integers(len(lines)))
        made = [line.encode() for line in lines]
        made[at] = damaged_json(lines[at], rng)
        return b"\n".join(made)
    if rng.random() < 0.2:
        return damaged_bytes(text.encode(), rng)
    if rng.random() < 0.02:
        return BRACKETS
    return json.dumps(damaged_value(json.loads(text), rng), ensure_ascii=bool(rng.random() < 0.5)).encode()


def damaged_yaml(text: str, rng: Rng) -> bytes:
    """Damage a YAML document: mostly its values, else its bytes, or nest it deeply, or add aliases that expand."""
    if rng.random() < 0.2:
        return damaged_bytes(text.encode(), rng)
    if rng.random() < 0.05:
        if rng.random() < 0.2:
            return BRACKETS
        return ALIASES if rng.random() < 0.5 else ALIASES + text.encode()
    value = damaged_value(yaml.safe_load(text), rng)
    return yaml.safe_dump(value, allow_unicode=bool(rng.random() < 0.5), sort_keys=False).encode()


def damaged_file(path: Path, rng: Rng) -> None:
    """Damage one file in place, by its extension; sometimes replace it with something that is not a file."""
    if rng.random() < 0.02:
        replace_with_no_file(path, rng)
        return
    damage = {".json": damaged_json, ".yaml": damaged_yaml, ".yml": damaged_yaml}.get(path.suffix)
    data = path.read_bytes()
    path.write_bytes(damage(data.decode(), rng) if damage is not None else damaged_bytes(data, rng))


def damaged_one_of(folder: Path, rng: Rng) -> None:
    """Damage one file of a folder, chosen by the generator."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    damaged_file(files[int(rng.integers(len(files)))], rng)


def replace_with_no_file(path: Path, rng: Rng) -> None:
    """Replace a file with what is none: an entry of `NO_FILE`."""
    path.unlink()
    list(NO_FILE.values())[int(rng.integers(len(NO_FILE)))](path)


def damaged_parquet(path: Path, rng: Rng) -> None:
    """Damage a Parquet file: mostly columns of other types and unusual values, else its bytes."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    if rng.random() < 0.4:
        damaged_file(path, rng)
        return
    table = pq.read_table(path)
    for _ in range(int(rng.integers(1, 3))):
        at = int(rng.integers(table.num_columns))
        name = table.column_names[at]
        found = STRANGE[int(rng.integers(len(STRANGE)))]
        values: list[Any] = [None, *table[name].to_pylist()[1:]] if rng.random() < 0.2 else [found] * len(table)
        try:
            column = pa.array(values, table.schema.field(name).type if rng.random() < 0.5 else None)
        except (pa.ArrowException, OverflowError, ValueError, TypeError):
            continue  # Arrow refuses this value
        table = table.drop_columns([name]) if rng.random() < 0.1 else table.set_column(at, name, column)
        if not table.num_columns:
            break
    content = pa.BufferOutputStream()
    try:
        pq.write_table(table, content)
    except pa.ArrowException:
        damaged_file(path, rng)  # Parquet refuses this table
    else:
        path.write_bytes(content.getvalue().to_pybytes())


def damaged_table(folder: Path, rng: Rng) -> None:
    """Damage the Parquet file of a folder."""
    damaged_parquet(next(folder.rglob("*.parquet")), rng)
