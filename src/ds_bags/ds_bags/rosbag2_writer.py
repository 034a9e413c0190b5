# SPDX-License-Identifier: Apache-2.0
"""Writes rosbag2 folders as ROS 2 Jazzy does: one MCAP file and `metadata.yaml`, version 9.

MCAP profile `ros2`, messages as `cdr`, schemas as `ros2msg` text. Each channel carries its QoS and the hash of its
type. A metadata record `rosbag2` repeats the folder's metadata, so readers need the file alone. A record
`digital_siblings` at the beginning describes the recording, so it survives when the writer is killed. The bytes of the
file are those of `mcap.writer.Writer`, which takes one message at a time; only framing and index are packed here.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import IO, Any

import numpy as np
import yaml
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from numpy.typing import NDArray
from rosbags.typesys.store import Typestore

from ds_bags.layout import MAX_TOPICS, BagError
from ds_base.bounded_yaml import load_yaml

_MAGIC = b"\x89MCAP0\r\n"
_FOOTER = struct.Struct("<BQQQ")
_MESSAGE = struct.Struct("<BQHIQQ")
_INDEX = struct.Struct("<BQHI")
_INDEX_ENTRY = struct.Struct("<QQ")
MESSAGE_HEAD = np.dtype(
    [("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("logged", "<u8"), ("sent", "<u8")]
)
"""What precedes the data of a message in its record."""
MESSAGE_COUNTED = MESSAGE_HEAD.itemsize - 9
"""Bytes of it that count into the length of its record: all but the opcode and the length itself."""


class McapWriter:
    """Writes one file: schemas, channels and messages in Zstandard chunks, metadata between them, an index at the end.

    Args:
        stream: file at position 0, which the caller closes.
        profile: profile of the file.
        library: name of the writing library.
    """

    def __init__(self, stream: IO[bytes], profile: str, library: str) -> None:
        self._stream = stream
        self._chunk = bytearray()
        self._indices: dict[int, bytearray] = {}
        self._first, self._last = 2**64 - 1, 0
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._chunks: list[ChunkIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._counts: dict[int, int] = {}
        stream.write(_MAGIC + _encoded(Header(profile, library)))

    def schema(self, name: str, encoding: str, data: bytes) -> int:
        """Declare a message type and return its number."""
        schema = Schema(id=len(self._schemas) + 1, data=data, encoding=encoding, name=name)
        self._schemas.append(schema)
        self._chunk += _encoded(schema)
        return schema.id

    def channel(self, topic: str, encoding: str, schema: int, metadata: Mapping[str, str]) -> int:
        """Declare a topic and return its number."""
        channel = Channel(
            id=len(self._channels) + 1,
            topic=topic,
            message_encoding=encoding,
            schema_id=schema,
            metadata=dict(metadata),
        )
        self._channels.append(channel)
        self._chunk += _encoded(channel)
        return channel.id

    def message(self, channel: int, sequence: int, nanoseconds: int, data: bytes) -> None:
        """Add one message, logged and published at a time in ns, to the chunk in progress."""
        self._count(channel, 1, _INDEX_ENTRY.pack(nanoseconds, len(self._chunk)), nanoseconds, nanoseconds)
        length = MESSAGE_COUNTED + len(data)
        self._chunk += _MESSAGE.pack(Opcode.MESSAGE, length, channel, sequence, nanoseconds, nanoseconds)
        self._chunk += data

    def messages(
        self, records: NDArray[np.uint8], channels: NDArray[Any], times: NDArray[Any], at: NDArray[Any]
    ) -> None:
        """Add whole message records to the chunk in progress.

        Args:
            records: bytes of the records, each a `MESSAGE_HEAD` and its data.
            channels: (n,) channel of each message.
            times: (n,) time of each message, ns.
            at: (n,) offset of each record from the first one.
        """
        entries = np.stack((times, at + len(self._chunk)), axis=1).astype("<u8")
        for channel in dict.fromkeys(channels.tolist()):
            found = entries[channels == channel]
            stamps = found[:, 0]
            self._count(channel, len(found), found.tobytes(), int(stamps.min()), int(stamps.max()))
        self._chunk += records.data

    def _count(self, channel: int, count: int, entries: bytes, first: int, last: int) -> None:
        self._indices.setdefault(channel, bytearray()).extend(entries)
        self._counts[channel] = self._counts.get(channel, 0) + count
        self._first, self._last = min(self._first, first), max(self._last, last)

    def metadata(self, name: str, data: Mapping[str, str]) -> None:
        """Write a metadata record before the chunk in progress."""
        record = _encoded(Metadata(name, dict(data)))
        self._metadata.append(MetadataIndex(offset=self._stream.tell(), length=len(record), name=name))
        self._stream.write(record)

    def flush(self) -> None:
        """End the chunk in progress, unless it has no messages, and hand everything to the operating system."""
        if self._indices:
            self._write_chunk()
        self._stream.flush()

    def _write_chunk(self) -> None:
        content = bytes(self._chunk)
        times = np.concatenate([np.frombuffer(index, "<u8")[::2] for index in self._indices.values()])
        chunk = Chunk(
            compression="zstd",
            data=zstandard.compress(content),
            message_start_time=int(times.min()),
            message_end_time=int(times.max()),
            uncompressed_crc=zlib.crc32(content),
            uncompressed_size=len(content),
        )
        record = _encoded(chunk)
        start = self._stream.tell()
        indices, offsets = bytearray(), {}
        for channel, entries in self._indices.items():
            offsets[channel] = start + len(record) + len(indices)
            indices += _INDEX.pack(Opcode.MESSAGE_INDEX, 6 + len(entries), channel, len(entries)) + entries
        self._stream.write(record + indices)
        self._chunks.append(
            ChunkIndex(
                message_start_time=chunk.message_start_time,
                message_end_time=chunk.message_end_time,
                chunk_start_offset=start,
                chunk_length=len(record),
                message_index_offsets=offsets,
                message_index_length=len(indices),
                compression=chunk.compression,
                compressed_size=len(chunk.data),
                uncompressed_size=len(content),
            )
        )
        self._chunk.clear()
        self._indices.clear()

    def finish(self) -> None:
        """Write the index of the file and its end."""
        self.flush()
        self._stream.write(_encoded(DataEnd(0)))
        count = sum(self._counts.values())
        statistics = Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunks),
            message_count=count,
            message_start_time=self._first if count else 0,
            message_end_time=self._last,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
        start = self._stream.tell()
        summary, offsets = b"", b""
        groups: tuple[tuple[Opcode, list[Any]], ...] = (
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, []),
            (Opcode.METADATA_INDEX, self._metadata),
        )
        for opcode, members in groups:
            group = _encoded(*members)
            offsets += _encoded(SummaryOffset(opcode, start + len(summary), len(group)))
            summary += group
        end = start + len(summary)
        crc = zlib.crc32(_FOOTER.pack(Opcode.FOOTER, 8 + 8 + 4, start, end), zlib.crc32(summary + offsets))
        footer = Footer(summary_start=start, summary_offset_start=end, summary_crc=crc)
        self._stream.write(summary + offsets + _encoded(footer) + _MAGIC)


def _encoded(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())


CHUNK_SIZE = 64 * 1024
"""Bytes of a chunk before compression; small, so a killed writer loses few messages."""
ABOUT_RECORD = "digital_siblings"
"""Name of the MCAP metadata record with the facts known at the start of the recording."""
_NEVER = {"sec": 9223372036, "nsec": 854775807}
"""Infinite duration as rmw writes it."""


@dataclass(frozen=True, kw_only=True)
class Topic:
    """Topic of a bag.

    Attributes:
        name: topic name with its namespace.
        message_type: type name such as `sensor_msgs/msg/Image`.
        definition: text of the type and of every type nested in it.
        digest: RIHS01 hash of the type.
        qos: QoS profile of the publisher, a YAML list of one.
        encoding: format of the definition, `ros2msg` or `ros2idl`.
    """

    name: str
    message_type: str
    definition: str
    digest: str
    qos: str
    encoding: str = "ros2msg"


# libyaml's dumper is eight times faster, but not every wheel includes it.
_Dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


def _yaml(value: Any) -> str:
    return str(yaml.dump(value, Dumper=_Dumper))


@lru_cache
def topic_of(typestore: Typestore, name: str, message_type: str, *, depth: int, latched: bool = False) -> Topic:
    """Make a topic with reliable QoS for a type of the typestore."""
    definition, _ = typestore.generate_msgdef(message_type, ros_version=2)
    return Topic(
        name=name,
        message_type=message_type,
        definition=definition,
        digest=typestore.hash_rihs01(message_type),
        qos=_yaml([_qos(depth, latched)]),
    )


class Rosbag2Writer:
    """Writes one bag. `close` completes it; without that, `ds_bags.copying` restores what was flushed.

    As a context manager, it closes the file at the end, completed or not.

    Args:
        folder: folder of the bag, created here; must not exist.
        about: facts known at the start; written to the file before the first message.
    """

    def __init__(self, folder: Path, about: Mapping[str, str]) -> None:
        folder.mkdir(parents=True)
        self._folder = folder
        self._file = (folder / f"{folder.name}.mcap").open("wb")
        self._mcap = McapWriter(self._file, profile="ros2", library="digital-siblings")
        self._mcap.metadata(ABOUT_RECORD, about)
        self._file.flush()
        self._schemas: dict[str, int] = {}
        self._topics: dict[int, Topic] = {}
        self._counts: dict[int, int] = {}
        self._first, self._last = 2**63 - 1, 0
        self._pending = 0

    def channel(self, topic: Topic) -> int:
        """Declare a topic and return its number for `write`.

        Raises:
            BagError: the bag would have more topics than this project's readers accept.
        """
        if len(self._topics) >= MAX_TOPICS:
            raise BagError(f"{self._folder.name} would have more than {MAX_TOPICS} topics: record fewer")
        if topic.message_type not in self._schemas:
            self._schemas[topic.message_type] = self._mcap.schema(
                topic.message_type, topic.encoding, topic.definition.encode()
            )
        number = self._mcap.channel(
            topic.name,
            "cdr",
            self._schemas[topic.message_type],
            {"offered_qos_profiles": topic.qos, "topic_type_hash": topic.digest},
        )
        self._topics[number], self._counts[number] = topic, 0
        return number

    def write(self, channel: int, nanoseconds: int, data: bytes) -> None:
        """Write one serialised message, logged and published at a time in ns."""
        self._mcap.message(channel, self._counts[channel], nanoseconds, data)
        self._counts[channel] += 1
        self._first, self._last = min(self._first, nanoseconds), max(self._last, nanoseconds)
        self._pending += len(data)
        if self._pending >= CHUNK_SIZE:
            self.flush()

    def write_frames(self, times: NDArray[np.int64], messages: Sequence[tuple[int, NDArray[np.uint8]]]) -> None:
        """Write messages of several channels frame by frame: the same as `write` for each one, but in one go.

        Args:
            times: (n,) time of each frame, ns.
            messages: channel, and (n, bytes) its message in each frame; in the order of a frame's messages.
        """
        count = len(times)
        if not count:
            return
        self._first, self._last = min(self._first, int(times.min())), max(self._last, int(times.max()))
        parts = []
        for channel, rows in messages:
            head = np.empty(count, MESSAGE_HEAD)
            head["opcode"], head["length"], head["channel"] = Opcode.MESSAGE, MESSAGE_COUNTED + rows.shape[1], channel
            head["sequence"] = self._counts[channel] + np.arange(count)
            head["logged"] = head["sent"] = times
            self._counts[channel] += count
            parts += [head.view(np.uint8).reshape(count, MESSAGE_HEAD.itemsize), rows]
        records = np.hstack(parts).ravel()
        channels = np.tile([channel for channel, _ in messages], count)
        sizes = np.tile([rows.shape[1] for _, rows in messages], count)
        ends = np.cumsum(sizes + MESSAGE_HEAD.itemsize)
        starts, stamps, written = (
            ends - sizes - MESSAGE_HEAD.itemsize,
            np.repeat(times, len(messages)),
            np.cumsum(sizes),
        )
        first = 0
        while first < len(sizes):
            before = int(written[first - 1]) if first else 0
            # Up to the message that fills the chunk, or the last one.
            last = min(int(np.searchsorted(written, before + CHUNK_SIZE - self._pending)), len(sizes) - 1)
            part, start = slice(first, last + 1), int(starts[first])
            self._mcap.messages(records[start : ends[last]], channels[part], stamps[part], starts[part] - start)
            self._pending += int(written[last]) - before
            if self._pending >= CHUNK_SIZE:
                self.flush()
            first = last + 1

    def flush(self) -> None:
        """Hand all messages so far to the operating system; they survive when the process is killed."""
        self._mcap.flush()
        self._pending = 0

    def close(self, custom_data: Mapping[str, str]) -> None:
        """Write index and metadata, and close the file.

        Args:
            custom_data: facts about the bag, for its metadata.
        """
        # After the last message: a file with this record is known to hold all messages.
        self.flush()
        self._mcap.metadata("rosbag2", {"serialized_metadata": self._information(custom_data, depth=0)})
        self._mcap.finish()
        self._file.close()
        text = "rosbag2_bagfile_information:\n" + self._information(custom_data, depth=1)
        (self._folder / "metadata.yaml").write_text(text)

    def __enter__(self) -> Rosbag2Writer:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def _information(self, custom_data: Mapping[str, str], *, depth: int) -> str:
        """Metadata of the bag as YAML, keys sorted, inside `depth` mappings."""
        start, count = min(self._first, self._last), sum(self._counts.values())
        file = {
            "path": f"{self._folder.name}.mcap",
            "starting_time": {"nanoseconds_since_epoch": start},
            "duration": {"nanoseconds": self._last - start},
            "message_count": count,
        }
        information = {
            "version": 9,
            "storage_identifier": "mcap",
            "relative_file_paths": [file["path"]],
            "starting_time": file["starting_time"],
            "duration": file["duration"],
            "message_count": count,
            "topics_with_message_count": [],
            "compression_format": "",
            "compression_mode": "",
            "files": [file],
            "custom_data": dict(custom_data),
            "ros_distro": "jazzy",
        }
        # Key by key, so that what all bags share is made once.
        parts = {key: _yaml_at(depth, {key: value}) for key, value in information.items()}
        if self._topics:
            indent = "  " * depth
            parts["topics_with_message_count"] = f"{indent}topics_with_message_count:\n" + "".join(
                f"{indent}- message_count: {self._counts[number]}\n{_topic_metadata(topic, depth)}"
                for number, topic in self._topics.items()
            )
        return "".join(text for _, text in sorted(parts.items()))


def _yaml_at(depth: int, value: Any) -> str:
    """YAML of a value inside mappings; long texts are folded where they are there."""
    for _ in range(depth):
        value = {"": value}
    lines = _yaml(value).splitlines(keepends=True)
    return "".join(lines[depth:])


@lru_cache(maxsize=256)
def _topic_metadata(topic: Topic, depth: int) -> str:
    """YAML of a topic's metadata, as part of an entry of a list inside `depth` mappings."""
    metadata = {
        "name": topic.name,
        "type": topic.message_type,
        "serialization_format": "cdr",
        "offered_qos_profiles": load_yaml(topic.qos) or [],
        "type_description_hash": topic.digest,
    }
    return _yaml_at(depth + 1, {"topic_metadata": metadata})


def _qos(depth: int, latched: bool) -> dict[str, Any]:
    """Make the QoS profile of a reliable publisher as rosbag2 of Jazzy writes it."""
    return {
        "history": "keep_last",
        "depth": depth,
        "reliability": "reliable",
        "durability": "transient_local" if latched else "volatile",
        "deadline": dict(_NEVER),
        "lifespan": dict(_NEVER),
        "liveliness": "automatic",
        "liveliness_lease_duration": dict(_NEVER),
        "avoid_ros_namespace_conventions": False,
    }
