"""Many bags in one, and back: a campaign's runs as one bag per map cell or search run, each run under its own name.

A pack is a rosbag2 folder itself: run NAME has its topic `/ds1/state` at `/NAME/ds1/state`, all runs begin at time 0,
and a plotter shows them over each other. Messages are copied as bytes, so what is unpacked is the bag that was packed.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml
from mcap.records import Channel, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader

from ds_bags.layout import BagError, partial_path
from ds_bags.rosbag2_writer import ABOUT_RECORD, Rosbag2Writer, Topic

PACKED_RECORD = "digital_siblings_packed"
"""Name of the MCAP metadata record that begins a bag in a pack."""


@dataclass(frozen=True, kw_only=True)
class Pack:
    """What was packed.

    Attributes:
        folder: of the pack.
        bags: how many are in it.
        bytes: of its files.
    """

    folder: Path
    bags: int
    bytes: int


def pack(bags: Sequence[Path], folder: Path, about: Mapping[str, str]) -> Pack:
    """Put bags into one.

    Args:
        bags: of one MCAP file each.
        folder: to make; appears whole or not at all.
        about: facts for its custom data.

    Raises:
        BagError: a bag cannot be read, or the folder exists.
    """
    if folder.exists():
        raise BagError(f"{folder} exists already: choose another --out")
    hidden = partial_path(folder)
    shutil.rmtree(hidden, ignore_errors=True)
    try:
        writer = Rosbag2Writer(hidden / folder.name, about)
        for bag in bags:
            _add(writer, bag)
        names = json.dumps([bag.name for bag in bags])
        writer.close({**about, "packed": str(len(bags)), "bags": names})
        folder.parent.mkdir(parents=True, exist_ok=True)
        (hidden / folder.name).rename(folder)
    finally:
        shutil.rmtree(hidden, ignore_errors=True)
    size = sum(file.stat().st_size for file in folder.iterdir())
    return Pack(folder=folder, bags=len(bags), bytes=size)


def unpack(folder: Path, out: Path, only: str | None = None) -> list[Path]:
    """Take bags out of a pack; the ones in it stay.

    Args:
        folder: of the pack.
        out: where their folders go.
        only: the name of one bag; all if None.

    Raises:
        BagError: no pack, no such bag in it, or a bag's folder exists.
    """
    made: list[Path] = []
    names: list[str] = []
    writer: Rosbag2Writer | None = None
    ending: dict[str, str] = {}
    prefix = ""
    schemas: dict[int, Schema] = {}
    channels: dict[int, int] = {}
    for record in _records(_file_of(folder)):
        if isinstance(record, Metadata) and record.name in (PACKED_RECORD, "rosbag2"):
            _finish(writer, ending, made)
            writer, channels = None, {}
            if record.name == PACKED_RECORD:
                name = record.metadata["name"]
                names.append(name)
                prefix, ending = f"/{topic_prefix(name)}", json.loads(record.metadata["custom_data"])
                if only in (None, name):
                    made.append(out / name)
                    writer = _begin(out / name, json.loads(record.metadata["about"]))
        elif isinstance(record, Schema):
            schemas[record.id] = record
        elif writer is not None and isinstance(record, Channel) and record.topic.startswith(f"{prefix}/"):
            topic = topic_of_channel(record, schemas[record.schema_id], record.topic.removeprefix(prefix))
            channels[record.id] = writer.channel(topic)
        elif writer is not None and isinstance(record, Message):
            writer.write(channels[record.channel_id], record.log_time, record.data)
    if not made:
        known = f"it holds {', '.join(names)}" if names else "it is no pack"
        raise BagError(f"{folder}: nothing to unpack: {known}")
    return made


def topic_prefix(name: str) -> str:
    """A bag's name as the first part of a topic's: letters, digits and underscores, not beginning with a digit."""
    text = "".join(c if c.isascii() and c.isalnum() else "_" for c in name)
    return text if text[:1].isalpha() else f"run_{text}"


def topic_of_channel(channel: Channel, schema: Schema, name: str) -> Topic:
    """A topic as a channel of an MCAP file has it, under another name."""
    return Topic(
        name=name,
        message_type=schema.name,
        definition=schema.data.decode(),
        digest=channel.metadata.get("topic_type_hash", ""),
        qos=channel.metadata.get("offered_qos_profiles", "[]\n"),
        encoding=schema.encoding,
    )


def _add(writer: Rosbag2Writer, bag: Path) -> None:
    file = _file_of(bag)
    information = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    custom = information.get("custom_data") or {}
    schemas: dict[int, Schema] = {}
    channels: dict[int, int] = {}
    begun = False
    for record in _records(file):
        if isinstance(record, Metadata) and record.name == ABOUT_RECORD:
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
        raise BagError(f"{bag} was not written by this version: packing it would lose what it says about itself")


def _file_of(bag: Path) -> Path:
    found = sorted(bag.glob("*.mcap"))
    if len(found) != 1 or not (bag / "metadata.yaml").is_file():
        raise BagError(f"{bag} is no whole bag of one MCAP file: `ds bag info` says what is wrong")
    return found[0]


def _records(file: Path) -> Iterator[McapRecord]:
    """Schemas, channels, messages and metadata in the order of the file."""
    with file.open("rb") as opened:
        records = iter(StreamReader(opened, validate_crcs=True).records)
        while True:
            try:
                record = next(records)
            except StopIteration:
                return
            except Exception as error:  # a damaged file raises whatever its reader stumbles on
                raise BagError(f"{file} is damaged ({error}): `ds bag recover` keeps what is whole") from None
            if isinstance(record, Schema | Channel | Message | Metadata):
                yield record


def _begin(folder: Path, about: dict[str, str]) -> Rosbag2Writer:
    if folder.exists():
        raise BagError(f"{folder} exists already: choose another --out")
    shutil.rmtree(partial_path(folder), ignore_errors=True)
    return Rosbag2Writer(partial_path(folder) / folder.name, about)


def _finish(writer: Rosbag2Writer | None, custom: dict[str, str], made: list[Path]) -> None:
    if writer is not None:
        writer.close(custom)
        hidden = partial_path(made[-1])
        (hidden / made[-1].name).rename(made[-1])
        hidden.rmdir()
