# SPDX-License-Identifier: Apache-2.0
"""Bags as other projects record them, written by rosbags."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore


@contextmanager
def foreign_bag(folder: Path, plugin: StoragePlugin = StoragePlugin.MCAP, **own: str) -> Iterator[ForeignBag]:
    """Write a bag; `own` are definitions of messages of the package `car`, by their names."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in own.items():
        store.register(get_types_from_msg(text, f"car/msg/{name}"))
    with Writer(folder, version=9, storage_plugin=plugin) as writer:
        yield ForeignBag(writer, store)


@dataclass
class ForeignBag:
    """A bag that is being written; messages are made by the names of their types, such as `std_msgs/Float64`."""

    writer: Writer
    store: Any
    connections: dict[str, Any] = field(default_factory=dict)

    def make(self, name: str, **fields: Any) -> Any:
        return self.store.types[name.replace("/", "/msg/")](**fields)

    def header(self, nanoseconds: int, frame: str = "") -> Any:
        stamp = self.make("builtin_interfaces/Time", sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
        return self.make("std_msgs/Header", stamp=stamp, frame_id=frame)

    def vector(self, x: float = 0.0, y: float = 0.0, z: float = 0.0, kind: str = "Vector3") -> Any:
        return self.make(f"geometry_msgs/{kind}", x=x, y=y, z=z)

    def image(self, nanoseconds: int, pixels: NDArray[np.uint8], encoding: str) -> Any:
        height, width, _ = pixels.shape
        about = {"height": height, "width": width, "encoding": encoding, "is_bigendian": 0, "step": 3 * width}
        return self.make("sensor_msgs/Image", header=self.header(nanoseconds), **about, data=pixels.reshape(-1))

    def write(self, topic: str, nanoseconds: int, message: Any) -> None:
        kind = message.__msgtype__
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        self.writer.write(self.connections[topic], nanoseconds, self.store.serialize_cdr(message, kind))
