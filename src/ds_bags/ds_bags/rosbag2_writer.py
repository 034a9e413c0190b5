"""Writes rosbag2 folders as ROS 2 Jazzy does: one MCAP file and `metadata.yaml`, version 9.

MCAP profile `ros2`, messages as `cdr`, schemas as `ros2msg` text. Each channel carries its QoS and the hash of its
type. A metadata record `rosbag2` repeats the folder's metadata, so readers need the file alone. A record
`digital_siblings` at the beginning describes the recording, so it survives when the writer is killed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from mcap.opcode import Opcode
from numpy.typing import NDArray
from rosbags.typesys.store import Typestore

from ds_bags.layout import BagError
from ds_bags.limits import MAX_TOPICS
from ds_bags.mcap_writer import MESSAGE_COUNTED, MESSAGE_HEAD, McapWriter
from ds_sim.bounded_yaml import load_yaml

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
    """Writes one bag. `close` completes it; without that, `ds_bags.recovery` restores what was flushed.

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
            raise BagError(
                f"{self._folder.name} would have more than {MAX_TOPICS} topics: put fewer bags into one pack"
            )
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

    def note(self, name: str, facts: Mapping[str, str]) -> None:
        """Append a metadata record after all messages so far."""
        self.flush()
        self._mcap.metadata(name, facts)

    def close(self, custom_data: Mapping[str, str]) -> None:
        """Write index and metadata, and close the file.

        Args:
            custom_data: facts about the bag, for its metadata.
        """
        # After the last message: a file with this record is known to hold all messages.
        self.note("rosbag2", {"serialized_metadata": self._information(custom_data, depth=0)})
        self._mcap.finish()
        self._file.close()
        text = "rosbag2_bagfile_information:\n" + self._information(custom_data, depth=1)
        (self._folder / "metadata.yaml").write_text(text)

    def abort(self) -> None:
        """Close the file without completing the bag."""
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
