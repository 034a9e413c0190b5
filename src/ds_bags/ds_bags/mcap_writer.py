"""Writes MCAP files, many messages in one call; the bytes are those of `mcap.writer.Writer`, which takes one at a time.

The records are those of the library; only the framing of messages and their index are packed here.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from typing import IO, Any

import numpy as np
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
