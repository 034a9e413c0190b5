# SPDX-License-Identifier: Apache-2.0
"""The reader of `rosbags` for any bag, kept to this project's limits.

`rosbags` decompresses a chunk of any size, loads YAML with a slow parser without limits, and turns every message
definition into Python code that it runs. Its reading modules are loaded here once more, for this project alone, with
functions that count first: nothing is decompressed beyond the budget of `ds_bags.layout`, and a definition becomes code
only if every name in it is a plain identifier and its size is bounded. Whoever else imports `rosbags` gets it as it is.
"""

from __future__ import annotations

import bz2
import re
import sys
from collections.abc import Callable
from functools import lru_cache, partial
from importlib.util import find_spec, module_from_spec
from types import SimpleNamespace
from typing import Any, ClassVar

import lz4.frame
from rosbags import highlevel, rosbag2
from rosbags.interfaces import Nodetype
from rosbags.rosbag2 import metadata
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from ds_bags.layout import TooLargeError, current_opening, parse_metadata
from ds_base.bounded_yaml import load_yaml

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

MAX_DEFINITION = 256 * 2**10
"""Characters of one message definition with all that it refers to; chosen: ten times the longest of the common ones."""
MAX_FIELDS = 5_000
"""Fields of all message types of a bag, each element of an array of strings or messages counted: each becomes code."""
_IDENTIFIER = re.compile(r"[A-Za-z][A-Za-z0-9_]*", re.ASCII)
_TYPE_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*(/[A-Za-z0-9_]+)*", re.ASCII)


_DECOMPRESSORS: dict[str, Callable[[], Any]] = {
    "zstd": zstd.ZstdDecompressor,
    "lz4": lz4.frame.LZ4FrameDecompressor,
    "bz2": bz2.BZ2Decompressor,
}


def opened(data: bytes, codec: str, size: int | None = None) -> bytes:
    """Decompress one part of a bag, by `zstd`, `lz4`, `bz2` or "", within the budget of the current pass.

    Beyond that is a TooLargeError; another codec, or other bytes than the declared `size`, are a ValueError.
    """
    opening = current_opening()
    if codec == "":
        opening.count(len(data))
        return data
    if codec not in _DECOMPRESSORS:
        raise ValueError(f"a part is compressed with {codec[:20]!r}, expected zstd, lz4 or bz2")
    if size is not None and size > opening.left:
        raise opening.too_much()
    limit = opening.left if size is None else size
    parts: list[bytes] = []
    total = 0
    while data:
        decompressor = _DECOMPRESSORS[codec]()
        while not decompressor.eof:
            part = decompressor.decompress(data, limit + 1 - total)
            data = b""
            total += len(part)
            parts.append(part)
            if total > limit:
                raise opening.too_much() if size is None else ValueError(f"a part opens to more than its {size} bytes")
            if not part and decompressor.needs_input:
                raise ValueError("a compressed part ends too early")
        data = decompressor.unused_data or b""
    opening.count(total)
    return b"".join(parts)


class _CountingFile(zstd.ZstdFile):
    """Decompressed file of a bag that is compressed by file."""

    def read(self, size: int | None = -1) -> bytes:
        part = bytes(super().read(size))
        current_opening().count(len(part))
        return part


class _SharedTypestore(Typestore):
    """A typestore that checks types before code is made of them, and makes it once for all bags with the same types."""

    _first: ClassVar[dict[str, _SharedTypestore]] = {}

    def register(self, typs: dict[str, Any]) -> None:
        check_types(typs)
        key = repr(sorted(typs.items()))
        if key not in self._first:
            super().register(typs)
            while len(self._first) >= 8:
                del self._first[next(iter(self._first))]
            self._first[key] = self
        first = self._first[key]
        self.fielddefs, self.types, self.cache = first.fielddefs, first.types, first.cache


_parse_qos: Callable[[Any], list[Any]] = metadata.parse_qos


@lru_cache(maxsize=2048)
def _qos(text: str) -> tuple[Any, ...]:
    profiles = load_yaml(text)
    return tuple(_parse_qos(profiles)) if isinstance(profiles, list) else ()


def _bounded_qos(profiles: Any) -> list[Any]:
    """QoS profiles; the topics of a bag repeat the same few texts."""
    return list(_qos(profiles)) if isinstance(profiles, str) else _parse_qos(profiles)


@lru_cache(maxsize=512)
def _types(parse: Callable[..., dict[str, Any]], text: str, *name: str) -> dict[str, Any]:
    if len(text) > MAX_DEFINITION:
        raise TooLargeError(f"a message definition has {len(text)} characters, the limit is {MAX_DEFINITION}")
    return parse(text, *name)


def check_types(types: dict[str, Any]) -> None:
    """Refuse types with names that are no identifiers, empty arrays or too many fields, before code is made of them."""
    fields_count = 0
    for name, (constants, fields) in types.items():
        names = [name, *(desc[1] for desc in _described(fields) if desc[0] == Nodetype.NAME)]
        if bad := [n for n in names if not _TYPE_NAME.fullmatch(n)]:
            raise ValueError(f"a message type is called {bad[0][:60]!r}")
        if bad := [n for n, *_ in [*fields, *constants] if not _IDENTIFIER.fullmatch(n)]:
            raise ValueError(f"a field of {name} is called {bad[0][:60]!r}")
        for field, desc in fields:
            fields_count += 1
            if desc[0] == Nodetype.ARRAY:
                inner, length = desc[1]
                if length < 1:
                    raise ValueError(f"{name}.{field} is an array of {length} elements")
                if inner[0] == Nodetype.NAME or inner[1][0] == "string":
                    fields_count += length
    if fields_count > MAX_FIELDS:
        raise TooLargeError(f"its message types have {fields_count} fields, the limit is {MAX_FIELDS}")


def check_ros1_types(types: dict[str, Any]) -> None:
    """Refuse sequences of elements of no bytes, of which a message of ROS 1 may claim billions."""
    sizes: dict[str, bool] = {}

    def takes_room(name: str, path: tuple[str, ...] = ()) -> bool:
        if name in path:
            raise ValueError(f"the message type {name} contains itself")
        if name not in sizes:
            fields = types.get(name, ((), ()))[1]
            sizes[name] = any(
                field != "structure_needs_at_least_one_member"
                and (desc[0] != Nodetype.NAME or takes_room(desc[1], (*path, name)))
                for field, desc in fields
            )
        return sizes[name]

    for name, (_, fields) in types.items():
        for _, desc in fields:
            if desc[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE):
                inner = desc[1][0]
                if inner[0] == Nodetype.NAME and not takes_room(inner[1], (name,)):
                    raise ValueError(f"{name} has a list of {inner[1]}, which has no fields")


def _described(fields: Any) -> list[Any]:
    """Type descriptions of fields, and of the elements of their arrays."""
    described = [desc for _, desc in fields]
    return described + [desc[1][0] for desc in described if desc[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE)]


def _loaded(name: str, **bounded: Any) -> Any:
    """Load a module of `rosbags` once more, with other values of some of its names."""
    spec = find_spec(name)
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    for key, value in bounded.items():
        assert hasattr(module, key), f"{name} has no {key} any more: see how it reads now"
        setattr(module, key, value)
    return module


_mcap = _loaded(
    "rosbags.rosbag2.storage_mcap",
    parse_qos=_bounded_qos,
    DECOMPRESSORS={codec: lambda data, size, codec=codec: opened(data, codec, size) for codec in ("", "lz4", "zstd")},
)
_sqlite3 = _loaded("rosbags.rosbag2.storage_sqlite3", parse_qos=_bounded_qos)
_folders = _loaded(
    "rosbags.rosbag2.reader",
    zstd=SimpleNamespace(decompress=partial(opened, codec="zstd"), open=_CountingFile),
    YAML=lambda typ: SimpleNamespace(load=parse_metadata),
    parse_qos=_bounded_qos,
)
_folders.DirectoryReader.STORAGE_PLUGINS = {"mcap": _mcap.McapReader, "sqlite3": _sqlite3.Sqlite3Reader}
_folders.Reader.STORAGE_PLUGINS = {
    "dir": _folders.DirectoryReader,
    ".mcap": _mcap.McapReader,
    ".db3": _sqlite3.Sqlite3Reader,
}
_ros1 = _loaded(
    "rosbags.rosbag1.reader",
    decompressors={name: partial(opened, codec=name.removeprefix("none")) for name in ("none", "bz2", "lz4")},
)
AnyReader: type[highlevel.AnyReader] = _loaded(
    "rosbags.highlevel.anyreader",
    Reader1=_ros1.Reader,
    Reader2=_folders.Reader,
    ReaderErrors=(_ros1.ReaderError, rosbag2.ReaderError),
    get_types_from_msg=partial(_types, get_types_from_msg),
    get_types_from_idl=partial(_types, get_types_from_idl),
    get_typestore=lambda kind: _SharedTypestore() if kind is Stores.EMPTY else get_typestore(kind),
).AnyReader
"""`rosbags.highlevel.AnyReader` within the limits."""
