"""The rosbag2 format of ROS 2 Jazzy: a folder with one MCAP file and `metadata.yaml`, version 9.

MCAP profile `ros2`, messages as `cdr`, schemas as `ros2msg` text; each channel carries its QoS and its type's hash, and
a metadata record `rosbag2` repeats the folder's metadata, so that the file alone is enough for a reader.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from mcap.writer import CompressionType, Writer
from rosbags.typesys.store import Typestore

CHUNK_SIZE = 64 * 1024
"""Bytes; small, so that a writer that is killed loses next to nothing of what it was given."""
_NEVER = {"sec": 9223372036, "nsec": 854775807}
"""An infinite duration as rmw writes it."""


class Rosbag2Writer:
    """Writes one bag; close it to make it whole.

    Args:
        folder: of the bag; must not exist.
        typestore: knows the messages' definitions and hashes.
    """

    def __init__(self, folder: Path, typestore: Typestore) -> None:
        folder.mkdir(parents=True)
        self._folder = folder
        self._typestore = typestore
        self._file = (folder / f"{folder.name}.mcap").open("wb")
        self._mcap = Writer(self._file, chunk_size=CHUNK_SIZE, compression=CompressionType.NONE)
        self._mcap.start(profile="ros2", library="digital-siblings")
        self._schemas: dict[str, int] = {}
        self._channels: dict[int, dict[str, Any]] = {}
        self._first, self._last = 2**63 - 1, 0

    def channel(self, topic: str, message_type: str, *, depth: int, latched: bool = False) -> int:
        """Declare a topic of reliable messages; its number is for `write`."""
        if message_type not in self._schemas:
            definition, _ = self._typestore.generate_msgdef(message_type, ros_version=2)
            self._schemas[message_type] = self._mcap.register_schema(message_type, "ros2msg", definition.encode())
        qos = [_qos(depth, latched)]
        digest = self._typestore.hash_rihs01(message_type)
        number = self._mcap.register_channel(
            topic,
            "cdr",
            self._schemas[message_type],
            {"offered_qos_profiles": yaml.safe_dump(qos), "topic_type_hash": digest},
        )
        topic_metadata = {
            "name": topic,
            "type": message_type,
            "serialization_format": "cdr",
            "offered_qos_profiles": qos,
            "type_description_hash": digest,
        }
        self._channels[number] = {"topic_metadata": topic_metadata, "message_count": 0}
        return number

    def write(self, channel: int, nanoseconds: int, message: Any) -> None:
        """Write one message, an object of the typestore's, at a time."""
        counted = self._channels[channel]
        data = bytes(self._typestore.serialize_cdr(message, counted["topic_metadata"]["type"]))
        self._mcap.add_message(channel, nanoseconds, data, nanoseconds, counted["message_count"])
        counted["message_count"] += 1
        self._first, self._last = min(self._first, nanoseconds), max(self._last, nanoseconds)

    def close(self, custom_data: Mapping[str, str]) -> None:
        """Write index and metadata.

        Args:
            custom_data: facts about the bag.
        """
        information = self._information(dict(custom_data))
        self._mcap.add_metadata("rosbag2", {"serialized_metadata": yaml.safe_dump(information)})
        self._mcap.finish()
        self._file.close()
        text = yaml.safe_dump({"rosbag2_bagfile_information": information})
        (self._folder / "metadata.yaml").write_text(text)

    def abort(self) -> None:
        """Leave the bag as it is."""
        self._file.close()

    def _information(self, custom_data: dict[str, str]) -> dict[str, Any]:
        count = sum(channel["message_count"] for channel in self._channels.values())
        start = min(self._first, self._last)
        file = {
            "path": f"{self._folder.name}.mcap",
            "starting_time": {"nanoseconds_since_epoch": start},
            "duration": {"nanoseconds": self._last - start},
            "message_count": count,
        }
        return {
            "version": 9,
            "storage_identifier": "mcap",
            "relative_file_paths": [file["path"]],
            "starting_time": dict(file["starting_time"]),
            "duration": dict(file["duration"]),
            "message_count": count,
            "topics_with_message_count": list(self._channels.values()),
            "compression_format": "",
            "compression_mode": "",
            "files": [file],
            "custom_data": custom_data,
            "ros_distro": "jazzy",
        }


def _qos(depth: int, latched: bool) -> dict[str, Any]:
    """A reliable publisher's profile as rosbag2 of Jazzy writes it."""
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
