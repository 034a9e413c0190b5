"""Packs many bags into one bag, each under its own name, and unpacks them.

A pack is itself a rosbag2 folder: topic `/ds1/state` of bag NAME becomes `/NAME/ds1/state`. All runs begin at time 0,
so plotting tools overlay them. Messages are copied as bytes, so unpacked bags equal the packed ones to the byte.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap.records import Channel, Message, Metadata, Schema

from ds_bags.copying import records, topic_of_channel
from ds_bags.layout import BagError, bag_information, bag_name, custom_data, new_folder, printable
from ds_bags.rosbag2_writer import ABOUT_RECORD, Rosbag2Writer

PACKED_RECORD = "digital_siblings_packed"
"""Name of the MCAP metadata record at the beginning of each bag in a pack."""


@dataclass(frozen=True, kw_only=True)
class Pack:
    """Result of packing.

    Attributes:
        folder: folder of the pack.
        bags: number of packed bags.
        bytes: size of the pack's files.
    """

    folder: Path
    bags: int
    bytes: int


def pack(bags: Sequence[Path], folder: Path, about: Mapping[str, str]) -> Pack:
    """Copy bags into one pack.

    Args:
        bags: folders of bags of one MCAP file each, with different names.
        folder: folder of the pack; appears whole or not at all.
        about: facts for the custom data of the pack.

    Raises:
        BagError: a bag cannot be read, two have the same name, there are too many bags, or the folder exists.

    Examples:
        >>> from pathlib import Path
        >>> from ds_bags import pack, unpack, write_bag
        >>> from ds_road import Road
        >>> from ds_sim import Session, make_simulator
        >>> session = Session(make_simulator("softbody"))
        >>> frame = session.start(Road([(125, 0), (125, 25), (125, 50), (125, 75)]), seed=1)
        >>> images = write_bag(Path("one"), "/ds2", "softbody", session.run, about={})
        >>> packed = pack([Path("one")], Path("all"), about={"campaign": "mine"})
        >>> [bag.name for bag in unpack(Path("all"), Path("again"))]
        ['one']
    """
    names = [bag_name(bag.name) for bag in bags]
    prefixes = [topic_prefix(name) for name in names]
    if duplicates := sorted({name for name, prefix in zip(names, prefixes, strict=True) if prefixes.count(prefix) > 1}):
        raise BagError(f"bags {', '.join(duplicates[:3])} would have the same topics: pack them separately")
    with new_folder(folder) as hidden, Rosbag2Writer(hidden, about) as writer:
        for bag in bags:
            _add(writer, bag)
        writer.close({**about, "packed": str(len(bags)), "bags": json.dumps(names)})
    size = sum(file.stat().st_size for file in folder.iterdir())
    return Pack(folder=folder, bags=len(bags), bytes=size)


def unpack(folder: Path, out: Path, only: str | None = None) -> list[Path]:
    """Copy bags out of a pack.

    Checks every name in the pack before it writes anything, and writes only inside `out`.

    Args:
        folder: folder of the pack.
        out: folder in which the bags' folders are created.
        only: name of the bag to unpack; all if None.

    Raises:
        BagError: not a pack, no such bag in it, a name that is not plain, or a folder that exists.
    """
    unpacked: list[Path] = []
    prefix = name = ""
    current: _UnpackedBag | None = None
    schemas: dict[int, Schema] = {}
    file = _file_of(folder)
    names = _names(file)
    for wanted in names if only is None else [only]:
        if wanted in names and os.path.lexists(out / wanted):
            raise BagError(f"{out / wanted} exists already: choose another --out")
    with ExitStack() as stack:
        for record, _ in records(file):
            if isinstance(record, Metadata) and record.name in (PACKED_RECORD, "rosbag2"):
                if current is not None:
                    current.finish()
                    unpacked.append(current.folder)
                    current = None
                if record.name == PACKED_RECORD:
                    name = bag_name(record.metadata.get("name"))
                    prefix = f"/{topic_prefix(name)}"
                    if only in (None, name):
                        about = _facts(folder, record, "about")
                        current = _UnpackedBag(stack, out / name, about, _facts(folder, record))
            elif isinstance(record, Schema):
                schemas[record.id] = record
            elif current is not None and isinstance(record, Channel) and record.topic.startswith(f"{prefix}/"):
                topic = topic_of_channel(record, schemas[record.schema_id], record.topic.removeprefix(prefix))
                current.channels[record.id] = current.writer.channel(topic)
            elif current is not None and isinstance(record, Message):
                if record.channel_id not in current.channels:
                    raise BagError(f"{folder}: a message of {name} has no topic of its own: copy the pack again")
                current.writer.write(current.channels[record.channel_id], record.log_time, record.data)
        if current is not None:
            raise BagError(f"{folder}: {name} has no end: `ds bag recover` keeps what is whole")
    if not unpacked:
        known = f"it holds {printable(', '.join(names))}" if names else "it is no pack"
        raise BagError(f"{folder}: nothing to unpack: {known}")
    return unpacked


class _UnpackedBag:
    """Bag that is being unpacked."""

    def __init__(self, stack: ExitStack, folder: Path, about: dict[str, str], ending: dict[str, str]) -> None:
        self.folder = folder
        self.channels: dict[int, int] = {}
        self._ending = ending
        self._stack = stack.enter_context(ExitStack())
        self.writer = self._stack.enter_context(Rosbag2Writer(self._stack.enter_context(new_folder(folder)), about))

    def finish(self) -> None:
        """Complete the bag and move it to its folder."""
        self.writer.close(self._ending)
        self._stack.close()


def _names(file: Path) -> list[str]:
    """Read and check the names of the bags in a pack, without reading chunks."""
    found = (record for record, _ in records(file, chunks=False))
    return [
        bag_name(record.metadata.get("name"))
        for record in found
        if isinstance(record, Metadata) and record.name == PACKED_RECORD
    ]


def _facts(folder: Path, record: Metadata, key: str = "custom_data") -> dict[str, str]:
    """Read the facts of a bag in a pack."""
    try:
        found: Any = json.loads(record.metadata[key])
        if all(isinstance(value, str) for value in found.values()):
            return dict(found)
    except (KeyError, ValueError, TypeError, AttributeError, RecursionError):
        pass
    raise BagError(f"{folder}: the facts of a bag in it cannot be read: copy the pack again")


def topic_prefix(name: str) -> str:
    """Convert a bag's name to the first part of a topic: letters, digits, underscores; first a letter."""
    text = "".join(c if c.isascii() and c.isalnum() else "_" for c in name)
    return text if text[:1].isalpha() else f"run_{text}"


def _add(writer: Rosbag2Writer, bag: Path) -> None:
    file = _file_of(bag)
    custom = custom_data(bag_information(bag))
    schemas: dict[int, Schema] = {}
    channels: dict[int, int] = {}
    begun = False
    for record, _ in records(file):
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
        raise BagError(f"{bag} was not written by this project: packing would lose its facts")


def _file_of(bag: Path) -> Path:
    found = sorted(bag.glob("*.mcap"))
    if len(found) != 1 or not (bag / "metadata.yaml").is_file():
        raise BagError(f"{bag} is no whole bag of one MCAP file: `ds bag info` says what is wrong")
    return found[0]
