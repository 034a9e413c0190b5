# SPDX-License-Identifier: Apache-2.0
"""Names, places and limits of bags on disk (docs/bags.md, SECURITY.md), and the errors of their readers and writers."""

from __future__ import annotations

import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import lru_cache
from pathlib import Path, PurePath
from typing import Any, Literal, get_args

from ds_base.bounded_file import FileError, read_regular
from ds_base.bounded_yaml import YamlLimits, load_yaml
from ds_base.errors import InputError
from ds_base.folder_files import make_parents, place_folder

Level = Literal["telemetry", "compressed", "raw"]
"""What a bag holds: everything but images, images as JPEG too, or images bit by bit."""
LEVELS: tuple[Level, ...] = get_args(Level)
TRANSLATED = "sim2real"
"""First part of the topics of images as the driver saw them, in place of `camera`; and fact of a bag whose images were
translated later: the digest of the generator."""
LONGEST_NAME = 200
"""Bytes of a file's name; chosen: file systems allow 255, and a hidden folder's additions need some of them."""


class BagError(InputError):
    """A bag that cannot be written or read."""


def partial_path(folder: Path) -> Path:
    """Folder in which a run's bag grows until it is whole."""
    return folder.with_name(f".{folder.name}.partial")


def plain_name(name: object) -> str:
    """Check a file's name that was read from a file before it becomes part of a path, which it could lead astray."""
    plain = isinstance(name, str) and name.isprintable() and not set(name) & {"/", "\\"}
    if isinstance(name, str) and plain and name and name[0] != "." and len(name.encode()) <= LONGEST_NAME:
        return name
    shown = repr(name if len(str(name)) <= 60 else f"{str(name)[:60]}...")
    raise BagError(f"{shown} is not a plain name of a file")


@contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """Yield a path to make a folder at, which appears whole at the end, or not at all; a BagError if it exists."""
    if os.path.lexists(folder):
        raise BagError(f"{folder} exists already: choose another --out")
    make_parents(folder)
    # A name of its own: a hidden folder that is there already belongs to somebody else.
    hidden = Path(tempfile.mkdtemp(prefix=f".{folder.name[:100]}.", suffix=".partial", dir=folder.parent))
    try:
        yield hidden / folder.name
        place_folder(hidden / folder.name, folder)
    finally:
        shutil.rmtree(hidden, ignore_errors=True)


MAX_METADATA = YamlLimits(size=16 * 2**20, nodes=1_000_000, depth=30)
"""Of a `metadata.yaml`; chosen: room for `MAX_TOPICS`."""
MAX_TOPICS = 10_000
"""Topics of one bag; chosen: a thousand times those of one run."""
OPENED_AT_LEAST = 64 * 2**20
"""Bytes that the compressed parts of a bag may open to, however small it is."""
OPENED_PER_BYTE = 100
"""Bytes that each byte of a bag's files may open to beyond that; chosen: ten times what telemetry takes."""
MAX_TIME = 2**31 * 10**9
"""ns; the first time that a ROS stamp cannot hold (January 2038)."""


class TooLargeError(BagError):
    """A bag beyond a limit; recovering it does not help."""


class Opening:
    """What one pass over a bag, whose files have so many bytes, may still decompress."""

    def __init__(self, size: int) -> None:
        self._limit = self.left = OPENED_AT_LEAST + OPENED_PER_BYTE * size

    @contextmanager
    def counting(self) -> Iterator[None]:
        """Count what is decompressed inside against this pass."""
        token = _current.set(self)
        try:
            yield
        finally:
            _current.reset(token)

    def count(self, size: int) -> None:
        """Count decompressed bytes, or raise `TooLargeError`."""
        self.left -= size
        if self.left < 0:
            raise self.too_much()

    def too_much(self) -> TooLargeError:
        """The error of a bag whose compressed parts open to more than the limit."""
        return TooLargeError(
            f"its compressed parts open to more than {self._limit / 2**20:.0f} MiB, the limit for a bag of this size"
        )


_current: ContextVar[Opening | None] = ContextVar("opening", default=None)


def current_opening() -> Opening:
    """The pass that counts here; outside of any, one of a small bag."""
    return _current.get() or Opening(0)


def regular_file(path: Path) -> Path:
    """The path, if it is a regular file or a link to one: opening a FIFO would wait, reading a device never ends."""
    try:
        if stat.S_ISREG(path.stat().st_mode):
            return path
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise BagError(f"{printable(path)} cannot be opened ({reason}): copy the bag again") from None
    raise BagError(f"{printable(path)} is not a regular file: copy the bag again, as files")


@lru_cache(maxsize=1)
def parse_metadata(text: str) -> Any:
    """Parse the text of a `metadata.yaml`; kept, as `rosbags` parses it once more.

    A storage that is not named, as by `ros2 bag reindex` of Humble, is the one of the files' names.
    """
    metadata = load_yaml(text, limits=MAX_METADATA)
    information = metadata.get("rosbag2_bagfile_information") if isinstance(metadata, dict) else None
    if isinstance(information, dict) and information.get("storage_identifier") == "":
        files = information.get("relative_file_paths")
        suffixes = {PurePath(str(file)).suffix for file in files} if isinstance(files, list) else set()
        if len(suffixes) == 1:
            information["storage_identifier"] = {".mcap": "mcap", ".db3": "sqlite3"}.get(suffixes.pop(), "")
    return metadata


def bag_information(folder: Path) -> dict[str, Any]:
    """What `metadata.yaml` says, with the types that every reader of it relies on, or a `BagError`."""
    path = regular_file(folder / "metadata.yaml")
    try:
        information = parse_metadata(read_regular(path, MAX_METADATA.size).decode())
    except UnicodeDecodeError:
        raise BagError(f"{path} cannot be read (not UTF-8 text): copy the bag again") from None
    except FileError as error:
        raise BagError(f"{path} cannot be read ({printable(error)}): copy the bag again") from None
    try:
        information = information["rosbag2_bagfile_information"]
        topics = [entry["topic_metadata"] for entry in information["topics_with_message_count"]]
        counts = [entry["message_count"] for entry in information["topics_with_message_count"]]
        counts += [information["message_count"], information["version"], information["duration"]["nanoseconds"]]
        counts += [information["starting_time"]["nanoseconds_since_epoch"]]
        texts = [topic[key] for topic in topics for key in ("name", "type", "serialization_format")]
        texts += [topic.get("type_description_hash", "") for topic in topics]
        texts += [information["storage_identifier"], *information["relative_file_paths"]]
        texts += [information.get(key) or "" for key in ("compression_format", "compression_mode", "ros_distro")]
        custom = information.get("custom_data") or {}
        values = [value for item in custom.items() for value in item]
    except (KeyError, TypeError, AttributeError) as error:
        reason = f"no {error}" if isinstance(error, KeyError) else "another structure"
        raise BagError(f"{path} is not as rosbag2 writes it ({reason}): copy the bag again") from None
    for kind, members in ((int, counts), (str, texts)):
        for value in members:
            if not isinstance(value, kind) or isinstance(value, bool):
                raise BagError(f"{path}: {printable(value)} where {kind.__name__} is expected: copy the bag again")
    if any(isinstance(value, dict | list) for value in values):
        raise BagError(f"{path}: custom data with a list or a mapping, expected text: copy the bag again")
    if not all(0 <= count < 2**63 for count in counts):
        raise BagError(f"{path}: a count or a time below 0 or beyond 63 bits: copy the bag again")
    names = [PurePath(name).name for name in information["relative_file_paths"]]
    if len(set(names)) < len(names) or not names:
        raise BagError(f"{path} names {'a file twice' if names else 'no file'}: copy the bag again")
    for name in names:
        regular_file(folder / name)
    if len(topics) > MAX_TOPICS:
        raise TooLargeError(f"{path} has {len(topics)} topics, the limit is {MAX_TOPICS}")
    return dict(information)


def custom_data(information: dict[str, Any]) -> dict[str, str]:
    """The custom data of a bag as text; empty if it has none."""
    items = (information.get("custom_data") or {}).items()
    return {str(key): "" if value is None else str(value) for key, value in items}


def printable(value: object, longest: int = 200) -> str:
    """A received text as one line of at most so many characters, without control characters."""
    text = value if isinstance(value, str) else str(value)[: 4 * longest]
    text = "".join(c if c.isprintable() else "?" for c in text[: longest + 1])
    return text if len(text) <= longest else f"{text[: longest - 3]}..."
