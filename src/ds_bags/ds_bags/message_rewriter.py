"""Copies a bag of this project with changed messages, such as translated images."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

from mcap.records import Channel, Message, Schema

from ds_bags.layout import BagError, new_folder
from ds_bags.mcap_records import records, topic_of_channel
from ds_bags.message_factory import typestore
from ds_bags.reader import BagReader
from ds_bags.rosbag2_writer import Rosbag2Writer


def rewrite_bag(
    source: Path,
    out: Path,
    change: Mapping[str, Callable[[Any], Any]],
    facts: Mapping[str, str],
    *,
    without: Collection[str] = (),
) -> int:
    """Copy a bag; the same input gives the same bytes.

    Args:
        source: bag of one MCAP file.
        out: bag to write; must not exist, and appears whole or not at all.
        change: message type -> function that returns the message to write.
        facts: custom data added to the bag's.
        without: message types that are left out.

    Returns:
        Number of changed messages.

    Raises:
        BagError: the bag is damaged, has several files, or `out` exists.
    """
    with BagReader(source) as bag:
        if len(bag.files) != 1 or bag.files[0].suffix != ".mcap":
            raise BagError(f"{source} is no bag of one MCAP file: record it with this project, or convert it")
        file, custom = bag.files[0], bag.facts | dict(facts)
    store, changed = typestore(), 0
    with new_folder(out) as hidden:
        writer = Rosbag2Writer(hidden, custom)
        try:
            schemas: dict[int, Schema] = {}
            channels: dict[int, tuple[int, str]] = {}
            for record, _ in records(file):
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel) and record.id not in channels:
                    kind = schemas[record.schema_id].name
                    if kind not in without:
                        number = writer.channel(topic_of_channel(record, schemas[record.schema_id], record.topic))
                        channels[record.id] = (number, kind)
                elif isinstance(record, Message) and record.channel_id in channels:
                    number, kind = channels[record.channel_id]
                    data = record.data
                    if kind in change:
                        message = change[kind](store.deserialize_cdr(data, kind))
                        data, changed = bytes(store.serialize_cdr(message, kind)), changed + 1
                    writer.write(number, record.log_time, data)
            writer.close(custom)
        except BaseException:
            writer.abort()
            raise
    return changed
