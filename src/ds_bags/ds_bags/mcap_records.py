"""Reads the records of an MCAP file one after the other, also of a file that is damaged or was never finished."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk

from ds_bags.bounded_rosbags import opened
from ds_bags.layout import BagError
from ds_bags.limits import MAX_TIME, Opening, TooLargeError, regular_file
from ds_bags.rosbag2_writer import Topic
from ds_sim.bounded_yaml import BoundedYamlError, load_yaml


class DamagedFileError(BagError):
    """A record that makes no sense; what came before it does.

    Attributes:
        reason: in a few words.
    """

    def __init__(self, file: Path, reason: str) -> None:
        super().__init__(f"{file} is damaged ({reason}): `ds bag recover` keeps what is whole")
        self.reason = reason


def records(file: Path, *, chunks: bool = True) -> Iterator[tuple[McapRecord, int]]:
    """Iterate over the records of a file in their order, those of chunks included.

    A message comes only after its channel, and a channel only after its schema; times fit a ROS stamp.

    Args:
        file: MCAP file.
        chunks: read what is inside chunks; False skips them, with schemas, channels and messages alike.

    Yields:
        Record, and how many bytes of the file have been read with it.

    Raises:
        DamagedFileError: the rest of the file makes no sense.
        TooLargeError: its chunks open to more than the limit.
    """
    size = regular_file(file).stat().st_size
    opening = Opening(size)
    schemas: set[int] = set()
    channels: set[int] = set()
    with file.open("rb") as stream:
        read = iter(StreamReader(stream, emit_chunks=True, validate_crcs=True, record_size_limit=size).records)
        while True:
            try:
                record = next(read)
                with opening.counting():
                    found = (_content(record) if chunks else []) if isinstance(record, Chunk) else [record]
                if chunks:
                    _check(found, schemas, channels)
            except StopIteration:
                return
            except TooLargeError as error:
                raise TooLargeError(f"{file}: {error}") from None
            except Exception as error:  # half a record raises whatever the reader stumbles on
                reason = " ".join(str(error).split())[:100] or type(error).__name__
                raise DamagedFileError(file, reason) from None
            position = stream.tell()
            for one in found:
                yield one, position


def _content(chunk: Chunk) -> list[McapRecord]:
    data = opened(chunk.data, chunk.compression, chunk.uncompressed_size)
    if len(data) != chunk.uncompressed_size:
        raise ValueError(f"a chunk of {len(data)} bytes, not {chunk.uncompressed_size}")
    whole = Chunk(
        compression="",
        data=data,
        message_start_time=chunk.message_start_time,
        message_end_time=chunk.message_end_time,
        uncompressed_crc=chunk.uncompressed_crc,
        uncompressed_size=chunk.uncompressed_size,
    )
    return list(breakup_chunk(whole, validate_crc=True))


def _check(found: list[McapRecord], schemas: set[int], channels: set[int]) -> None:
    for record in found:
        if isinstance(record, Schema):
            record.data.decode()
            schemas.add(record.id)
        elif isinstance(record, Channel):
            if record.schema_id not in schemas:
                raise ValueError(f"channel {record.id} has no schema")
            channels.add(record.id)
        elif isinstance(record, Message) and (record.channel_id not in channels or record.log_time >= MAX_TIME):
            raise ValueError(f"a message of channel {record.channel_id} at {record.log_time} ns")


def topic_of_channel(channel: Channel, schema: Schema, name: str) -> Topic:
    """Describe a channel of an MCAP file as a topic, under another name; a QoS that makes no sense is left out."""
    qos = channel.metadata.get("offered_qos_profiles", "[]\n")
    try:
        profiles = load_yaml(qos)
        known = not profiles or (isinstance(profiles, list) and all(isinstance(profile, dict) for profile in profiles))
    except BoundedYamlError:
        known = False
    return Topic(
        name=name,
        message_type=schema.name,
        definition=schema.data.decode(),
        digest=channel.metadata.get("topic_type_hash", ""),
        qos=qos if known else "[]\n",
        encoding=schema.encoding,
    )
