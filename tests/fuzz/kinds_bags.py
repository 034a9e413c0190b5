# SPDX-License-Identifier: Apache-2.0
"""Kinds of received files: bags, tubs, located recordings, descriptions of ROS 2 simulators, and plain YAML."""

from __future__ import annotations

import json
import shutil
from functools import lru_cache, partial
from pathlib import Path

import cv2
import numpy as np
from foreign_bags import foreign_bag
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_typestore
from tests.fuzz.damage import Rng, damaged_bytes, damaged_file, damaged_one_of, damaged_value
from tests.fuzz.harness import Kind
from tests.fuzz.kinds_tables import as_text
from tubs import write_tub

from ds_bags.copying import recover
from ds_bags.donkey_tub import TubError, read_tub
from ds_bags.info import describe, info_in_words
from ds_bags.layout import BagError, Level
from ds_bags.reader import BagReader, read_run
from ds_bags.run_writer import write_bag
from ds_base.bounded_file import FileError
from ds_base.bounded_yaml import read_yaml
from ds_driver.data.recordings import Reading, open_recording
from ds_recording import RecordingError
from ds_recording.floor_camera import FloorCamera, read_camera, write_camera
from ds_recording.located import COLUMNS, Located, write_located
from ds_recording.sibling.recorded_drive import sections
from ds_recording.sibling.simulator import RecordingSimulator
from ds_recording.track import Track
from ds_road import Road
from ds_sim.registry import DONKEY, UntrustedSimulatorError, make_simulator
from ds_sim.scenario import Scenario
from ds_sim.session import RunRecord, Session
from ds_sim.simulator import Command
from ds_sim_ros.settings import RosSettingsError
from ds_sim_ros.simulator import RosSimulator
from ds_twin_donkey.logs import LogError, read_log

_YAML = """\
name: a campaign
simulators: [donkey, bullet]
gains: {low: 0.5, high: 1.5e3, on: true, none: ~}
base: &base {seed: 7, roads: [[0, 1.5], [2, 3]]}
more: {<<: *base, seed: 8}
"""
_ERRORS = (BagError, UntrustedSimulatorError)


@lru_cache
def _run(frames: int) -> RunRecord:
    session = Session(make_simulator("donkey"))
    session.start(Scenario(Road([(125.0 + i % 2, 25.0 * i) for i in range(9)]), seed=3))
    for _ in range(frames):
        session.advance(Command(0.0, 0.2))
    session.simulator.close()
    assert session.run is not None
    return session.run


def _write_bag(folder: Path, n: int, level: Level = "telemetry") -> Path:
    write_bag(folder / "bag", "/twin", DONKEY, _run(n), {"driver": "autopilot"}, level)
    return folder / "bag"


def _write_unfinished(folder: Path, n: int) -> Path:
    return Path(shutil.copy(_write_bag(folder, n) / "bag.mcap", folder / "left.mcap"))


def _write_foreign(folder: Path, n: int) -> Path:
    """Write a rosbag2 in SQLite, as other projects do."""
    with foreign_bag(folder / "bag", StoragePlugin.SQLITE3) as bag:
        for number in range(n):
            bag.write("/text", number, bag.make("std_msgs/String", data="x" * (number % 9)))
    return folder / "bag"


def _write_ros1(folder: Path, n: int) -> Path:
    store = get_typestore(Stores.ROS1_NOETIC)
    make = store.types["std_msgs/msg/String"]
    file = Ros1Writer(folder / "file.bag")
    file.set_compression(Ros1Writer.CompressionFormat.LZ4)
    with file as writer:
        connection = writer.add_connection("/text", "std_msgs/msg/String", typestore=store)
        for number in range(n):
            message = make(data="x" * (number % 9))  # type: ignore[call-arg]
            writer.write(connection, number, store.serialize_ros1(message, "std_msgs/msg/String"))
    return folder / "file.bag"


def tub(folder: Path, n: int) -> Path:
    """Write a tub of n records and images."""
    (folder / "tub/images").mkdir(parents=True)
    rows = []
    for index in range(n):
        name = f"{index}_cam_image_array_.jpg"
        cv2.imwrite(str(folder / "tub/images" / name), np.full((40, 80, 3), 30 * (index % 6), np.uint8))
        commands = {"user/angle": 0.1 * (index % 9), "user/throttle": 0.3, "user/mode": "user", "cam/image_array": name}
        rows.append(commands | {"pos/pos_x": 0.1 * index, "pos/pos_z": 0.0, "pos/speed": 2.0})
    return write_tub(folder / "tub", rows, deleted=[n - 1])


def _damage_lines(folder: Path, rng: Rng) -> None:
    """Damage one file of a tub: the values of a line if it is text."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    file = files[int(rng.integers(len(files)))]
    if file.suffix == ".jpg" or rng.random() < 0.2:
        damaged_file(file, rng)
        return
    lines = file.read_text().splitlines()
    at = len(lines) - 1 if file.suffix == ".json" else int(rng.integers(len(lines)))
    lines[at] = json.dumps(damaged_value(json.loads(lines[at]), rng))
    file.write_text("\n".join(lines) + "\n")


def _damage_records(folder: Path, rng: Rng) -> None:
    """Damage the content of records in a bag's MCAP file, and make its checksums valid again."""
    if rng.random() < 0.3:
        damaged_one_of(folder, rng)
        return
    file = next(folder.glob("*.mcap")) if folder.is_dir() else folder
    data = file.read_bytes()
    what, at = int(rng.integers(4)), float(rng.random())
    with file.open("rb") as old:
        reader = make_reader(old)
        summary = reader.get_summary()
        assert summary is not None
        channels, schemas = summary.channels, summary.schemas
        messages = [message for _, _, message in reader.iter_messages(log_time_order=False)]
        metadata = list(reader.iter_metadata())
    chosen = int(at * 1000)

    def changed(value: str | bytes, here: bool) -> bytes:
        raw = value.encode() if isinstance(value, str) else value
        return damaged_bytes(raw, rng) if here else raw

    def text(value: str, here: bool) -> str:
        return changed(value, here).decode(errors="replace")

    with file.open("wb") as new:
        writer = Writer(new, compression=CompressionType.ZSTD, chunk_size=2**20)
        writer.start(profile="ros2", library="fuzz")
        for number, record in enumerate(metadata[:-1] if len(metadata) > 1 else metadata):
            here = what == 0 and number == chosen % len(metadata)
            values = dict(record.metadata)
            if here and values:
                key = sorted(values)[chosen % len(values)]
                values[key] = text(values[key], True)
                if rng.random() < 0.5:
                    values[key] = json.dumps(damaged_value(values[key], rng))
            writer.add_metadata(record.name, values)
        numbers = {}
        for count, schema in enumerate(schemas.values()):
            here = what == 1 and count == chosen % len(schemas)
            which = int(rng.integers(3)) if here else -1
            numbers[schema.id] = writer.register_schema(
                text(schema.name, which == 0), text(schema.encoding, which == 1), changed(schema.data, which == 2)
            )
        topics = {}
        for count, channel in enumerate(channels.values()):
            here = what == 2 and count == chosen % len(channels)
            which = int(rng.integers(2)) if here else -1
            about = {key: text(value, which == 1) for key, value in channel.metadata.items()}
            topics[channel.id] = writer.register_channel(
                text(channel.topic, which == 0), channel.message_encoding, numbers[channel.schema_id], about
            )
        for count, message in enumerate(messages):
            here = what == 3 and count == chosen % len(messages)
            time = int(rng.integers(2**63)) if here and rng.random() < 0.2 else message.log_time
            writer.add_message(topics[message.channel_id], time, changed(message.data, here), message.publish_time)
        for record in metadata[-1:] if len(metadata) > 1 else []:
            writer.add_metadata(record.name, record.metadata)
        writer.finish()
    assert file.read_bytes() != data


def _read_everything(path: Path) -> None:
    """Read as `ds bag info` does, and deserialise every message."""
    info_in_words(describe(path))
    with BagReader(path) as bag:
        for connection, _, raw in bag.messages():
            bag.message(connection, raw)


def _read_run(path: Path) -> None:
    with BagReader(path) as bag:
        read_run(bag)


def _read_recording(path: Path) -> None:
    for _ in open_recording(path, Reading()).frames():
        pass


def _recover(path: Path) -> None:
    recover(path, path.parent / "out")
    shutil.rmtree(path.parent / "out")


def _damage_bag(path: Path, rng: Rng) -> None:
    (damaged_one_of, _damage_records)[int(rng.integers(2))](path, rng)


_CAMERA = FloorCamera(
    width_px=80, height_px=40, focal_px=(37.5, 37.5), centre_x_px=39.5, centre_y_px=19.5, height_m=0.12, pitch_rad=0.2
)


def _write_located(folder: Path, n: int) -> Path:
    made = folder / "located"
    made.mkdir()
    source = tub(made, n)
    along = 0.35 * np.arange(n - 1.0)
    table = np.zeros((n - 1, len(COLUMNS)))
    frames = np.arange(n - 1.0)
    for name, values in {"frame": frames, "time_s": 0.05 * frames, "x_m": along, "along_m": along}.items():
        table[:, COLUMNS.index(name)] = values
    track = Track(np.column_stack((np.linspace(-1.0, 0.35 * n + 3.0, 4 * n + 1), np.zeros(4 * n + 1))))
    about = {"source": source.name, "lane_width_m": 0.25, "closed": False}
    write_located(made, Located(table=table, track=track, lane_width=0.25, camera=_CAMERA, about=about))
    (made / "simulator.yaml").write_text("crop_top: 40\n")
    return made


def _drive(folder: Path) -> None:
    """Make the sibling, and drive some frames of a section."""
    simulator = RecordingSimulator.from_file(folder)
    drive = simulator.drive
    session = Session(simulator)
    session.start(Scenario(sections(drive, 20.0)[0], seed=1))
    for _ in range(3):
        if session.driving:
            session.advance(Command(0.1, 0.5))


def _write_camera(folder: Path, n: int) -> Path:
    write_camera(folder / "camera.yaml", _CAMERA)
    return folder / "camera.yaml"


def _write_description(folder: Path, n: int) -> Path:
    made = folder / "described"
    made.mkdir()
    text = (Path(__file__).parents[2] / "examples/ros_simulator.yaml").read_text()
    (made / "track.csv").write_text("".join(f"{30 * k / n},{3 * (k / n) ** 2}\n" for k in range(n)))
    (made / "sim.yaml").write_text(text.replace("{service: /load_road}", "{centre_line: track.csv}"))
    return made


KINDS = [
    Kind(
        "yaml",
        as_text(lambda n: _YAML + "".join(f"k{k}: [{k}]\n" for k in range(n)), "file.yaml"),
        damaged_file,
        read_yaml,
        (FileError, OSError),
        200,
        small=0,
    ),
    Kind("bag-info", _write_bag, _damage_bag, _read_everything, _ERRORS, 20, small=4),
    Kind("bag-run", _write_bag, _damage_bag, _read_run, _ERRORS, 20, small=4),
    Kind("bag-log", _write_bag, _damage_bag, read_log, (LogError,), 20, small=4),
    Kind("bag-sqlite", _write_foreign, damaged_one_of, _read_everything, _ERRORS, 500, small=5),
    Kind("bag-ros1", _write_ros1, damaged_file, _read_everything, _ERRORS, 500, small=5),
    Kind("bag-images", partial(_write_bag, level="compressed"), _damage_bag, _read_recording, _ERRORS, 20, small=4),
    Kind("bag-recover", _write_unfinished, damaged_file, _recover, _ERRORS, 20, small=4),
    Kind("tub", tub, _damage_lines, read_tub, (TubError,), 100, small=6),
    Kind("tub-images", tub, _damage_lines, _read_recording, (TubError, BagError), 50, small=6),
    Kind("tub-log", tub, _damage_lines, read_log, (LogError,), 100, small=6),
    Kind(
        "ros-description",
        _write_description,
        damaged_one_of,
        lambda folder: RosSimulator.from_file(folder / "sim.yaml"),
        (RosSettingsError,),
        1000,
        small=4,
    ),
    Kind("located", _write_located, damaged_one_of, _drive, (RecordingError,), 60, small=6),
    Kind("located-log", _write_located, damaged_one_of, read_log, (LogError,), 200, small=6),
    Kind("floor-camera", _write_camera, damaged_file, read_camera, (RecordingError,)),
]
