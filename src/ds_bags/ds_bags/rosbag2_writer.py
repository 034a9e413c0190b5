# SPDX-License-Identifier: Apache-2.0
"""Writes rosbag2 folders as ROS 2 Jazzy does: one MCAP file and `metadata.yaml`, version 9.

A metadata record `rosbag2` repeats the folder's metadata, so readers need the file alone. A record `digital_siblings`
at the beginning describes the recording, so it survives when the writer is killed.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import yaml
from mcap.writer import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from ds_bags.layout import MAX_TOPICS, BagError
from ds_base.bounded_file import read_words
from ds_base.bounded_yaml import load_yaml
from ds_base.errors import InputError
from ds_base.folder_files import make_parents, write_whole
from ds_base.installation import share_folders

CHUNK_SIZE = 64 * 1024
"""Bytes of a chunk before compression; small, so a killed writer loses few messages."""
ABOUT_RECORD = "digital_siblings"
"""Name of the MCAP metadata record with the facts known at the start of the recording."""
_OWN_MESSAGES = ("Outcome", "Road", "VehicleState", "DriveCommand")
_NEVER = {"sec": 9223372036, "nsec": 854775807}
"""Infinite duration as rmw writes it."""


@dataclass(frozen=True, kw_only=True)
class Topic:
    """Topic of a bag."""

    name: str
    message_type: str
    definition: str  # text of the type and of every type nested in it
    digest: str  # RIHS01 hash of the type
    qos: str  # profile of the publisher, a YAML list of one
    encoding: str = "ros2msg"  # of the definition, or `ros2idl`


class _Dumper(getattr(yaml, "CSafeDumper", yaml.SafeDumper)):  # type: ignore[misc]
    """libyaml's where the wheel includes it, eight times faster; writes what occurs twice out twice."""

    def ignore_aliases(self, data: Any) -> bool:
        del data
        return True


def _yaml(value: Any) -> str:
    return str(yaml.dump(value, Dumper=_Dumper))


@lru_cache(maxsize=1)
def typestore() -> Typestore:
    """Message types of Jazzy and of `ds_interfaces`, the latter read from their installed definitions."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for share in share_folders("ds_interfaces"):
        folder = share / "msg"
        if (folder / "Road.msg").exists():
            types: dict[str, Any] = {}
            for name in _OWN_MESSAGES:
                types.update(get_types_from_msg(read_words(folder / f"{name}.msg"), f"ds_interfaces/msg/{name}"))
            store.register(types)
            return store
    raise InputError("ds_interfaces is not on AMENT_PREFIX_PATH: build the workspace and source its setup file")


@lru_cache
def topic_of(name: str, message_type: str, *, depth: int, latched: bool = False) -> Topic:
    """Make a topic with reliable QoS for a type of the typestore."""
    definition, _ = typestore().generate_msgdef(message_type, ros_version=2)
    return Topic(
        name=name,
        message_type=message_type,
        definition=definition,
        digest=typestore().hash_rihs01(message_type),
        qos=_yaml([_qos(depth, latched)]),
    )


class Rosbag2Writer:
    """Writes one bag into a new folder, after the facts `about` it that are known at the start.

    `close` completes it; without that, `ds_bags.copying` restores what was flushed. As a context manager, it closes the
    file at the end, completed or not.
    """

    def __init__(self, folder: Path, about: Mapping[str, str]) -> None:
        make_parents(folder)
        folder.mkdir()
        self._folder = folder
        self._file = (folder / f"{folder.name}.mcap").open("wb")
        # Chunks end where `flush` is called, never by themselves.
        self._mcap = Writer(self._file, chunk_size=2**62)
        self._mcap.start("ros2", "digital-siblings")
        self._mcap.add_metadata(ABOUT_RECORD, dict(about))
        self._file.flush()
        self._schemas: dict[str, int] = {}
        self._topics: dict[int, Topic] = {}
        self._counts: dict[int, int] = {}
        self._first, self._last = 2**63 - 1, 0
        self._pending = 0

    def channel(self, topic: Topic) -> int:
        """Declare a topic and return its number for `write`; a BagError beyond what this project's readers accept."""
        if len(self._topics) >= MAX_TOPICS:
            raise BagError(f"{self._folder.name} would have more than {MAX_TOPICS} topics: record fewer")
        if topic.message_type not in self._schemas:
            self._schemas[topic.message_type] = self._mcap.register_schema(
                topic.message_type, topic.encoding, topic.definition.encode()
            )
        number = self._mcap.register_channel(
            topic.name,
            "cdr",
            self._schemas[topic.message_type],
            {"offered_qos_profiles": topic.qos, "topic_type_hash": topic.digest},
        )
        self._topics[number], self._counts[number] = topic, 0
        return number

    def write(self, channel: int, nanoseconds: int, data: bytes) -> None:
        """Write one serialised message, logged and published at a time in ns."""
        self._mcap.add_message(channel, nanoseconds, data, nanoseconds, self._counts[channel])
        self._counts[channel] += 1
        self._first, self._last = min(self._first, nanoseconds), max(self._last, nanoseconds)
        self._pending += len(data)
        if self._pending >= CHUNK_SIZE:
            self.flush()

    def flush(self) -> None:
        """Hand all messages so far to the operating system; they survive when the process is killed."""
        self._mcap.flush()
        self._pending = 0

    def close(self, custom_data: Mapping[str, str]) -> None:
        """Write index and metadata with facts about the bag, and close the file."""
        # After the last message: a file with this record is known to hold all messages.
        self.flush()
        information = self._information(custom_data)
        self._mcap.add_metadata("rosbag2", {"serialized_metadata": _yaml(information)})
        self._mcap.finish()
        self._file.flush()
        os.fsync(self._file.fileno())  # a campaign's store names the bag next, and a power cut must not keep that alone
        self._file.close()
        write_whole(self._folder / "metadata.yaml", _yaml({"rosbag2_bagfile_information": information}))

    def __enter__(self) -> Rosbag2Writer:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def _information(self, custom_data: Mapping[str, str]) -> dict[str, Any]:
        start = {"nanoseconds_since_epoch": min(self._first, self._last)}
        duration = {"nanoseconds": self._last - min(self._first, self._last)}
        path, count = f"{self._folder.name}.mcap", sum(self._counts.values())
        return {
            "version": 9,
            "storage_identifier": "mcap",
            "relative_file_paths": [path],
            "starting_time": start,
            "duration": duration,
            "message_count": count,
            "topics_with_message_count": [
                {"message_count": self._counts[number], "topic_metadata": _topic_metadata(topic)}
                for number, topic in self._topics.items()
            ],
            "compression_format": "",
            "compression_mode": "",
            "files": [{"path": path, "starting_time": start, "duration": duration, "message_count": count}],
            "custom_data": dict(custom_data),
            "ros_distro": "jazzy",
        }


def _topic_metadata(topic: Topic) -> dict[str, Any]:
    return {
        "name": topic.name,
        "type": topic.message_type,
        "serialization_format": "cdr",
        "offered_qos_profiles": load_yaml(topic.qos) or [],
        "type_description_hash": topic.digest,
    }


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
