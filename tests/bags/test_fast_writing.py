# SPDX-License-Identifier: Apache-2.0
"""Bags are written many messages at once; the bytes are those of libraries that take one message at a time."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import IO, Any

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from ds_bags import rosbag2_writer
from ds_bags.messages import MessageTable, frame_times, message_builder, serialise_frames, typestore
from ds_bags.rosbag2_writer import CHUNK_SIZE, MESSAGE_HEAD, Rosbag2Writer, Topic
from ds_bags.run_writer import write_bag
from ds_road import Road
from ds_sim.registry import spec_of
from ds_sim.scenario import Scenario
from ds_sim.session import NO_IMAGE, RunRecord
from ds_sim.simulator import Command, LaneState, Observation, Outcome, VehicleState

ROAD = Road([(125.0 + 8.0 * (i % 2), 25.0 * i) for i in range(9)])
FILE = ("bag/bag.mcap", "bag/metadata.yaml")


def a_run(frames: int, seed: int = 1) -> RunRecord:
    """A run of random states, so that no field is where another one would have the same value."""
    rng = np.random.default_rng(seed)
    seen = [
        Observation(
            image=NO_IMAGE,
            step=step,
            time=step / 20,
            vehicle=VehicleState(**{field.name: rng.normal(0, 3) for field in fields(VehicleState)}),
            lane=LaneState(**{field.name: rng.normal(0, 3) for field in fields(LaneState)}),
            outcome=Outcome(int(rng.integers(8))),
        )
        for step in range(frames)
    ]
    commands = [Command(float(rng.uniform(-1, 1)), float(rng.uniform(0, 1))) for _ in seen[1:]]
    return RunRecord(scenario=Scenario(ROAD, seed=seed), observations=seen, commands=commands, outcome=Outcome.STUCK)


class LibraryWriter:
    """`McapWriter` by the library's writer."""

    def __init__(self, stream: IO[bytes], profile: str, library: str) -> None:
        self._writer = Writer(stream, chunk_size=2**62, compression=CompressionType.ZSTD)
        self._writer.start(profile, library)
        self.schema = self._writer.register_schema
        self.finish = self._writer.finish
        self.flush = self._writer.flush

    def channel(self, topic: str, encoding: str, schema: int, metadata: Mapping[str, str]) -> int:
        return self._writer.register_channel(topic, encoding, schema, dict(metadata))

    def metadata(self, name: str, data: Mapping[str, str]) -> None:
        self._writer.add_metadata(name, dict(data))

    def message(self, channel: int, sequence: int, nanoseconds: int, data: bytes) -> None:
        self._writer.add_message(channel, nanoseconds, data, nanoseconds, sequence)

    def messages(self, records: Any, channels: Any, times: Any, at: Any) -> None:
        content = records.tobytes()
        for start, channel, time in zip(at.tolist(), channels.tolist(), times.tolist(), strict=True):
            length, number, sequence, logged, _ = struct.unpack_from("<QHIQQ", content, start + 1)
            assert (number, logged) == (channel, time)
            self.message(channel, sequence, time, content[start + MESSAGE_HEAD.itemsize : start + 9 + length])


def written(folder: Path) -> list[bytes]:
    return [(folder / name).read_bytes() for name in FILE]


@pytest.mark.graph
def test_frames_serialised_at_once_are_those_serialised_one_by_one() -> None:
    run, make, store = a_run(50), message_builder("/twin"), typestore()
    rows = serialise_frames(make, run)
    for index, (seen, time) in enumerate(zip(run.observations, frame_times(run).tolist(), strict=True)):
        header = make.header(time, "road")
        messages = {
            "state": make.state(seen, header, ROAD.road_id),
            "odom": make.odometry(seen.vehicle, header.stamp),
            "/tf": make.body_transform(seen.vehicle, header.stamp),
        }
        if index < len(run.commands):
            messages["drive"] = make.command(run.commands[index], header)
        for topic, message in messages.items():
            assert rows[topic][index].tobytes() == bytes(store.serialize_cdr(message, message.__msgtype__)), topic


@pytest.mark.graph
def test_every_number_of_a_message_has_its_place() -> None:
    """Strings, arrays and sequences before a number, of types with every alignment."""
    store, make = typestore(), message_builder("/twin")
    marker = make.road_markers(ROAD, spec_of("donkey").look, make.stamp(0))
    table = MessageTable(store, marker, 2)
    for path, value in (("markers.1.color.g", 0.25), ("markers.2.lifetime.sec", -7), ("markers.2.points.5.z", 1.5)):
        table.put(path, [value, value])
    marker.markers[1].color.g = 0.25
    marker.markers[2].lifetime.sec = -7
    marker.markers[2].points[5].z = 1.5
    expected = bytes(store.serialize_cdr(marker, marker.__msgtype__))
    assert [row.tobytes() for row in table.rows] == [expected, expected]


@pytest.mark.graph
@pytest.mark.parametrize("frames", [0, 1, 2, 435])
def test_a_bag_has_the_bytes_that_the_mcap_library_writes(
    frames: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_bag(tmp_path / "ours" / "bag", "/twin", "donkey", a_run(frames), {"driver": "autopilot"})
    monkeypatch.setattr(rosbag2_writer, "McapWriter", LibraryWriter)
    write_bag(tmp_path / "theirs" / "bag", "/twin", "donkey", a_run(frames), {"driver": "autopilot"})
    assert written(tmp_path / "ours") == written(tmp_path / "theirs")


@pytest.mark.parametrize("seed", range(5))
def test_frames_written_at_once_are_chunked_as_if_written_one_by_one(seed: int, tmp_path: Path) -> None:
    """Messages from none to more than a chunk, before, between and after single ones."""
    rng = np.random.default_rng(seed)
    frames = [int(n) for n in rng.integers(0, 40, 4)]
    sizes = [int(n) for n in rng.choice([0, 5, 900, CHUNK_SIZE // 2, CHUNK_SIZE + 1], 3)]
    writers = [Rosbag2Writer(tmp_path / name / "bag", {"seed": "1"}) for name in ("at_once", "one_by_one")]
    for writer in writers:
        for number in range(3):
            writer.channel(Topic(name=f"/t{number}", message_type="x/msg/X", definition="", digest="d", qos="[]\n"))
    for count in frames:
        times = np.sort(rng.integers(0, 10**9, count))
        rows = [(number + 1, rng.integers(0, 9, (count, size), np.uint8)) for number, size in enumerate(sizes)]
        writers[0].write_frames(times, rows)
        for index, time in enumerate(times.tolist()):
            for number, messages in rows:
                writers[1].write(number, time, messages[index].tobytes())
        for writer in writers:
            writer.write(2, 10**9, b"between")
    for writer in writers:
        writer.close({"outcome": "STUCK"})
    assert written(tmp_path / "at_once") == written(tmp_path / "one_by_one")


@pytest.mark.graph
def test_metadata_assembled_from_parts_is_what_the_yaml_library_writes(bags: Path, tmp_path: Path) -> None:
    writer = Rosbag2Writer(tmp_path / "empty", {})
    long = {"message": "words " * 60, "road": "[1, 2], " * 90, "é: -": "a\nb", "number": "1", "": ""}
    writer.close(long)
    for folder in (bags / "compressed", tmp_path / "empty"):
        outside = (folder / "metadata.yaml").read_text()
        with (folder / f"{folder.name}.mcap").open("rb") as file:
            (record,) = (found for found in make_reader(file).iter_metadata() if found.name == "rosbag2")
        inside = record.metadata["serialized_metadata"]
        for text in (outside, inside):
            assert yaml.dump(yaml.safe_load(text), Dumper=rosbag2_writer._Dumper) == text
        assert yaml.safe_load(outside) == {"rosbag2_bagfile_information": yaml.safe_load(inside)}
    assert yaml.safe_load(inside)["custom_data"] == long
