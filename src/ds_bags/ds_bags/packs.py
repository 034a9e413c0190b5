"""Packs: many bags in one bag, each under its own name, and back.

A pack is a rosbag2 folder itself: bag NAME has its topic `/ds1/state` at `/NAME/ds1/state`. All runs begin at time 0,
so a plotter shows them over each other. Messages are copied as bytes: what is unpacked is what was packed, to the byte.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap.records import Channel, McapRecord, Message, Metadata, Schema

from ds_bags.layout import BagError, bag_name, new_folder
from ds_bags.limits import bag_information, custom_data, printable
from ds_bags.mcap_records import records, topic_of_channel
from ds_bags.rosbag2_writer import ABOUT_RECORD, Rosbag2Writer

PACKED_RECORD = "digital_siblings_packed"
"""Name of the MCAP metadata record that begins a bag in a pack."""


@dataclass(frozen=True, kw_only=True)
class Pack:
    """A pack that was written.

    Attributes:
        folder: of the pack.
        bags: number of bags in it.
        bytes: size of its files.
    """

    folder: Path
    bags: int
    bytes: int


def pack(bags: Sequence[Path], folder: Path, about: Mapping[str, str]) -> Pack:
    """Put bags into one pack; the bags stay.

    Args:
        bags: folders of bags of one MCAP file each, with different names.
        folder: pack to make; appears whole or not at all.
        about: facts for its custom data.

    Raises:
        BagError: a bag cannot be read, two have the same name, there are too many, or the folder exists.
    """
    names = [bag_name(bag.name) for bag in bags]
    prefixes = [topic_prefix(name) for name in names]
    if twice := sorted({name for name, prefix in zip(names, prefixes, strict=True) if prefixes.count(prefix) > 1}):
        raise BagError(f"bags {', '.join(twice[:3])} would have the same topics: pack them separately")
    with new_folder(folder) as hidden:
        writer = Rosbag2Writer(hidden, about)
        try:
            for bag in bags:
                _add(writer, bag)
            writer.close({**about, "packed": str(len(bags)), "bags": json.dumps(names)})
        except BaseException:
            writer.abort()
            raise
    size = sum(file.stat().st_size for file in folder.iterdir())
    return Pack(folder=folder, bags=len(bags), bytes=size)


def unpack(folder: Path, out: Path, only: str | None = None) -> list[Path]:
    """Take bags out of a pack; the pack stays.

    Nothing is written outside `out`, and nothing at all before every name in the pack has been checked.

    Args:
        folder: pack to read.
        out: folder in which the bags' folders are made.
        only: name of one bag to take out; all if None.

    Raises:
        BagError: not a pack, no such bag in it, a name that is not plain, or a bag's folder exists.
    """
    made: list[Path] = []
    prefix = name = ""
    taken: _Taken | None = None
    schemas: dict[int, Schema] = {}
    file = _file_of(folder)
    names = _names(file)
    for wanted in names if only is None else [only]:
        if wanted in names and os.path.lexists(out / wanted):
            raise BagError(f"{out / wanted} exists already: choose another --out")
    with ExitStack() as stack:
        for record in _records(file):
            if isinstance(record, Metadata) and record.name in (PACKED_RECORD, "rosbag2"):
                if taken is not None:
                    taken.finish()
                    made.append(taken.folder)
                    taken = None
                if record.name == PACKED_RECORD:
                    name = bag_name(record.metadata.get("name"))
                    prefix = f"/{topic_prefix(name)}"
                    if only in (None, name):
                        taken = _Taken(stack, out / name, _facts(folder, record, "about"), _facts(folder, record))
            elif isinstance(record, Schema):
                schemas[record.id] = record
            elif taken is not None and isinstance(record, Channel) and record.topic.startswith(f"{prefix}/"):
                topic = topic_of_channel(record, schemas[record.schema_id], record.topic.removeprefix(prefix))
                taken.channels[record.id] = taken.writer.channel(topic)
            elif taken is not None and isinstance(record, Message):
                if record.channel_id not in taken.channels:
                    raise BagError(f"{folder}: a message of {name} has no topic of its own: copy the pack again")
                taken.writer.write(taken.channels[record.channel_id], record.log_time, record.data)
        if taken is not None:
            raise BagError(f"{folder}: {name} has no end: `ds bag recover` keeps what is whole")
    if not made:
        known = f"it holds {printable(', '.join(names))}" if names else "it is no pack"
        raise BagError(f"{folder}: nothing to unpack: {known}")
    return made


class _Taken:
    """One bag that is being taken out."""

    def __init__(self, stack: ExitStack, folder: Path, about: dict[str, str], ending: dict[str, str]) -> None:
        self.folder = folder
        self.channels: dict[int, int] = {}
        self._ending = ending
        self._stack = stack.enter_context(ExitStack())
        self.writer = Rosbag2Writer(self._stack.enter_context(new_folder(folder)), about)
        self._stack.push(lambda kind, error, trace: self.writer.abort() if kind else None)

    def finish(self) -> None:
        """Write the end, and let the folder appear."""
        self.writer.close(self._ending)
        self._stack.close()


def _names(file: Path) -> list[str]:
    """Names of the bags in a pack, checked; chunks are skipped."""
    found = (record for record, _ in records(file, chunks=False))
    return [
        bag_name(record.metadata.get("name"))
        for record in found
        if isinstance(record, Metadata) and record.name == PACKED_RECORD
    ]


def _facts(folder: Path, record: Metadata, key: str = "custom_data") -> dict[str, str]:
    """Facts of a bag in a pack."""
    try:
        found: Any = json.loads(record.metadata[key])
        if all(isinstance(value, str) for value in found.values()):
            return dict(found)
    except (KeyError, ValueError, TypeError, AttributeError, RecursionError):
        pass
    raise BagError(f"{folder}: what a bag in it says about itself cannot be read: copy the pack again")


def topic_prefix(name: str) -> str:
    """Make a topic's first part of a bag's name: letters, digits and underscores, not beginning with a digit."""
    text = "".join(c if c.isascii() and c.isalnum() else "_" for c in name)
    return text if text[:1].isalpha() else f"run_{text}"


def _add(writer: Rosbag2Writer, bag: Path) -> None:
    file = _file_of(bag)
    custom = custom_data(bag_information(bag))
    schemas: dict[int, Schema] = {}
    channels: dict[int, int] = {}
    begun = False
    for record in _records(file):
        if isinstance(record, Metadata) and record.name == ABOUT_RECORD and not begun:
            texts = {"about": json.dumps(record.metadata), "custom_data": json.dumps(custom)}
            writer.note(PACKED_RECORD, {"name": bag.name, **texts})
            begun = True
        elif isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel) and record.id not in channels:
            name = f"/{topic_prefix(bag.name)}{record.topic}"
            channels[record.id] = writer.channel(topic_of_channel(record, schemas[record.schema_id], name))
        elif isinstance(record, Message):
            writer.write(channels[record.channel_id], record.log_time, record.data)
    if not begun:
        raise BagError(f"{bag} was not written by this project: packing it would lose what it says about itself")


def _file_of(bag: Path) -> Path:
    found = sorted(bag.glob("*.mcap"))
    if len(found) != 1 or not (bag / "metadata.yaml").is_file():
        raise BagError(f"{bag} is no whole bag of one MCAP file: `ds bag info` says what is wrong")
    return found[0]


def _records(file: Path) -> Iterator[McapRecord]:
    """Schemas, channels, messages and metadata in the order of the file."""
    for record, _ in records(file):
        if isinstance(record, Schema | Channel | Message | Metadata):
            yield record
