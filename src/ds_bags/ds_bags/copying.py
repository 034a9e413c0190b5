# SPDX-License-Identifier: Apache-2.0
"""Copies the records of MCAP files: whole files, files with changed messages, and files that were never finished."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mcap.records import Channel, Chunk, Footer, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk

from ds_bags.bounded_rosbags import opened
from ds_bags.layout import (
    MAX_METADATA,
    MAX_TIME,
    BagError,
    Opening,
    TooLargeError,
    custom_data,
    new_folder,
    partial_path,
    regular_file,
)
from ds_bags.reader import STATE, BagReader
from ds_bags.rosbag2_writer import ABOUT_RECORD, Rosbag2Writer, Topic, typestore
from ds_base.bounded_file import open_regular
from ds_base.bounded_yaml import BoundedYamlError, load_yaml
from ds_base.installation import ds_command


class DamagedFileError(BagError):
    """A record that makes no sense; what came before it does."""


def records(file: Path) -> Iterator[tuple[tuple[int, Topic] | Message | Metadata | Footer, int]]:
    """Iterate over numbered topics, messages, metadata and footer of a file in their order, those of chunks included.

    A message comes only after its topic; times fit a ROS stamp. With each record comes how many bytes of the file have
    been read with it. A DamagedFileError says that the rest makes no sense.
    """
    size = regular_file(file).stat().st_size
    opening = Opening(size)
    schemas: dict[int, Schema] = {}
    topics: dict[int, Topic] = {}
    with open_regular(file) as stream:
        read = iter(StreamReader(stream, emit_chunks=True, validate_crcs=True, record_size_limit=size).records)
        while True:
            try:
                record = next(read)
                with opening.counting():
                    raw = _content(record) if isinstance(record, Chunk) else [record]
                checked = [one for one in raw if _is_new(one, schemas, topics)]
            except StopIteration:
                return
            except TooLargeError as error:
                raise TooLargeError(f"{file}: {error}") from None
            except Exception as error:  # half a record raises whatever the reader stumbles on
                reason = " ".join(str(error).split())[:100] or type(error).__name__
                text = f"{file} is damaged ({reason}): `ds bag recover` keeps what is whole"
                raise DamagedFileError(text) from None
            position = stream.tell()
            for one in checked:
                if isinstance(one, Channel):
                    yield (one.id, topics[one.id]), position
                elif isinstance(one, Message | Metadata | Footer):
                    yield one, position


def _content(chunk: Chunk) -> list[McapRecord]:
    data = opened(chunk.data, chunk.compression, chunk.uncompressed_size)
    if len(data) != chunk.uncompressed_size:
        raise ValueError(f"a chunk of {len(data)} bytes, not {chunk.uncompressed_size}")
    return list(breakup_chunk(replace(chunk, compression="", data=data), validate_crc=True))


def _is_new(record: McapRecord, schemas: dict[int, Schema], topics: dict[int, Topic]) -> bool:
    """Keep schemas and topics; False for a topic that was there already."""
    if isinstance(record, Schema):
        schemas[record.id] = record
    elif isinstance(record, Channel):
        if record.schema_id not in schemas:
            raise ValueError(f"channel {record.id} has no schema")
        if record.id in topics:
            return False
        topics[record.id] = _topic_of(record, schemas[record.schema_id])
    elif isinstance(record, Message) and (record.channel_id not in topics or record.log_time >= MAX_TIME):
        raise ValueError(f"a message of channel {record.channel_id} at {record.log_time} ns")
    return True


def _topic_of(channel: Channel, schema: Schema) -> Topic:
    """Describe a channel of an MCAP file as a topic; a QoS that makes no sense is left out."""
    qos = channel.metadata.get("offered_qos_profiles", "[]\n")
    try:
        profiles = load_yaml(qos) or []
        is_usable = isinstance(profiles, list) and all(isinstance(profile, dict) for profile in profiles)
    except BoundedYamlError:
        is_usable = False
    return Topic(
        name=channel.topic,
        message_type=schema.name,
        definition=schema.data.decode(),
        digest=channel.metadata.get("topic_type_hash", ""),
        qos=qos if is_usable else "[]\n",
        encoding=schema.encoding,
    )


def rewrite_bag(
    source: Path,
    out: Path,
    change: Mapping[str, Callable[[Any], Any]],
    facts: Mapping[str, str],
    *,
    without: Collection[str] = (),
) -> int:
    """Copy a bag of one MCAP file, whole or not at all; the same input gives the same bytes.

    Functions change the messages of their types, those of other types are left out or kept, and facts are added to the
    custom data. Returns the number of changed messages; a BagError if the bag is damaged or `out` exists.
    """
    with BagReader(source) as bag:
        if len(bag.files) != 1 or bag.files[0].suffix != ".mcap":
            raise BagError(f"{source} is no bag of one MCAP file: record it with this project, or convert it")
        file, custom = bag.files[0], bag.facts | dict(facts)
    store, changed = typestore(), 0
    channels: dict[int, tuple[int, str]] = {}
    with new_folder(out) as hidden, Rosbag2Writer(hidden, custom) as writer:
        for record, _ in records(file):
            if isinstance(record, tuple) and record[1].message_type not in without:
                channels[record[0]] = writer.channel(record[1]), record[1].message_type
            elif isinstance(record, Message) and record.channel_id in channels:
                number, kind = channels[record.channel_id]
                data = record.data
                if kind in change:
                    message = change[kind](store.deserialize_cdr(data, kind))
                    data, changed = bytes(store.serialize_cdr(message, kind)), changed + 1
                writer.write(number, record.log_time, data)
        writer.close(custom)
    return changed


UNFINISHED = "UNFINISHED"
"""Outcome in the custom data of a recovered bag."""


@dataclass(frozen=True, kw_only=True)
class Recovered:
    """Recovered bag, and the bytes at the end of its source that could not be read."""

    source: Path
    folder: Path
    messages: int
    seconds: float
    lost_bytes: int


def unfinished_file(path: Path) -> Path:
    """Find the MCAP file of a killed writer, given a bag's intended path, its hidden folder, or the file."""
    if path.is_file():
        return path
    for folder in (path, path / path.name.removeprefix(".").removesuffix(".partial"), partial_path(path) / path.name):
        files = sorted(folder.glob("*.mcap"))
        if files and (folder / "metadata.yaml").exists():
            raise BagError(f"{folder} is whole: `{ds_command('bag', 'info', folder)}` describes it")
        if files:
            return files[0]
    raise BagError(f"{path}: nothing to recover: expected an .mcap file in it, or in {partial_path(path)}")


def recover(path: Path, out: Path | None = None) -> Recovered:
    """Make a whole bag from an unfinished one, which stays as it is.

    Keeps every record up to the first damaged one, in order. The new folder is next to the unfinished bag, with a name
    that ends in `_recovered`, where none is given.

    Raises:
        BagError: there is no unfinished bag, nothing in it can be read, or `out` exists.
    """
    source = regular_file(unfinished_file(path))
    if out is None:
        beside = source.parent.parent if source.parent.parent.name.endswith(".partial") else source.parent
        out = beside.parent / f"{source.stem}_recovered"
    with new_folder(out) as hidden:
        return _copy(source, hidden, out)


def _copy(source: Path, folder: Path, out: Path) -> Recovered:
    facts: dict[str, str] = {}
    channels: dict[int, int] = {}
    writer: Rosbag2Writer | None = None
    ended: dict[str, str] = {}
    count, first, last, readable, frames, states = 0, 0, 0, 0, 0, set[int]()
    with contextlib.suppress(DamagedFileError):
        for record, position in records(source):
            # After the footer comes only the closing magic.
            readable = source.stat().st_size if isinstance(record, Footer) else position
            if isinstance(record, Metadata) and record.name == ABOUT_RECORD:
                facts = dict(record.metadata)
            elif isinstance(record, Metadata) and record.name == "rosbag2":
                # The file was finished but its folder was not: use the outcome that the file states.
                ended = _ending(record)
            elif isinstance(record, tuple):
                writer = writer or Rosbag2Writer(folder, facts)
                channels[record[0]] = writer.channel(record[1])
                states |= {record[0]} if record[1].message_type == STATE else set()
            elif isinstance(record, Message) and writer is not None:
                writer.write(channels[record.channel_id], record.log_time, record.data)
                first = record.log_time if not count else min(first, record.log_time)
                last, count = max(last, record.log_time), count + 1
                frames += record.channel_id in states
    if writer is None or not count:
        raise BagError(f"{source} holds no whole chunk: the writer was killed before its first flush")
    lost = source.stat().st_size - readable
    cut = {"outcome": UNFINISHED, "message": f"recovered: {frames} frames, the last {lost} bytes could not be read"}
    writer.close(facts | (ended or cut))
    return Recovered(source=source, folder=out, messages=count, seconds=(last - first) / 1e9, lost_bytes=lost)


def _ending(record: Metadata) -> dict[str, str]:
    """Return the custom data at the end of a finished file; empty if it is malformed."""
    try:
        information = load_yaml(record.metadata["serialized_metadata"], limits=MAX_METADATA)
        return custom_data(information)
    except (BoundedYamlError, KeyError, AttributeError, TypeError):
        return {}
