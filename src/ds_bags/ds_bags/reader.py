# SPDX-License-Identifier: Apache-2.0
"""Reads bags from any source: rosbag2 folders with MCAP or SQLite files, and ROS 1 `.bag` files."""

from __future__ import annotations

import math
import sqlite3
import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from rosbags.interfaces import Connection
from rosbags.typesys import Stores, get_typestore

from ds_bags.bounded_rosbags import AnyReader, check_ros1_types
from ds_bags.layout import (
    MAX_TIME,
    MAX_TOPICS,
    BagError,
    Opening,
    TooLargeError,
    bag_information,
    custom_data,
    partial_path,
    printable,
    regular_file,
)
from ds_base.bounded_file import load_json, open_regular
from ds_base.installation import ds_command
from ds_road import Road, RoadError, road_from_json
from ds_sim.conditions.text import parse_conditions
from ds_sim.messages import road_from_message
from ds_sim.registry import SimulatorName, received_simulator
from ds_sim.scenario import MAX_SEED, Scenario
from ds_sim.session import NO_IMAGE, RunRecord
from ds_sim.simulator import Command, CommandError, LaneState, Observation, Outcome, VehicleState

STATE, DRIVE = "ds_interfaces/msg/VehicleState", "ds_interfaces/msg/DriveCommand"
ROAD = "ds_interfaces/msg/Road"
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
ROS1_MAGIC = b"#ROSBAG V2.0\n"
_STORAGE = (".mcap", ".db3")


class BagReader:
    """Reads an open bag within the limits of `ds_bags.layout`. Use it as a context manager.

    Args:
        path: rosbag2 folder, or a ROS 1 `.bag` file.

    Attributes:
        path: folder or file that is read.
        facts: custom data of the bag, as text.
        files: files that hold the messages.

    Raises:
        BagError: there is no bag, or it is unfinished, damaged, or beyond a limit.
    """

    def __init__(self, path: Path) -> None:
        self.path = _place_of(path)
        _check_finished(self.path)
        self.facts: dict[str, str] = {}
        self.files = [self.path]
        if self.path.is_dir():
            information = bag_information(self.path)
            self.facts = custom_data(information)
            self.files = [self.path / Path(name).name for name in information["relative_file_paths"]]
        self._size = sum(regular_file(file).stat().st_size for file in self.files)
        try:
            for file in self.files:
                if file.suffix == ".db3":
                    _check_tables(file)
                elif file.suffix == ".bag":
                    _check_first_line(file)
            with Opening(self._size).counting():
                self._reader = AnyReader([self.path], default_typestore=get_typestore(Stores.ROS2_JAZZY))
                self._reader.open()
            self._check()
        except Exception as error:  # damaged files make the reader raise arbitrary errors
            raise self._damaged(error) from None

    def _check(self) -> None:
        """Check the types, topics and message counts of the open bag."""
        if not self._reader.is2:
            check_ros1_types(dict(self._reader.typestore.fielddefs))
        if len(self._reader.connections) > MAX_TOPICS:
            raise TooLargeError(f"it has {len(self._reader.connections)} topics, the limit is {MAX_TOPICS}")
        for connection in self._reader.connections:
            if not isinstance(connection.topic, str) or not connection.topic:
                raise ValueError(f"a topic has the name {printable(connection.topic)!r}")
        if self._reader.is2 and self.path.is_dir():
            # A rosbag2 folder has one reader, with one storage per file.
            storages: Any = getattr(self._reader.readers[0].storage, "storages", [])  # type: ignore[union-attr]
            counted = sum(storage.metadata.message_count for storage in storages)
            if counted != self._reader.message_count:
                raise ValueError(f"metadata.yaml counts {self._reader.message_count} messages, its files {counted}")

    def _damaged(self, error: Exception) -> BagError:
        if isinstance(error, TooLargeError):
            return TooLargeError(f"{self.path}: {printable(error)}")
        if isinstance(error, BagError):
            return error
        text = printable(" ".join(str(error).split())) or type(error).__name__
        return BagError(
            f"{self.path} cannot be read ({text}): try `{ds_command('bag', 'recover', self.path, '--out', 'DIR')}`"
        )

    @property
    def connections(self) -> list[Connection]:
        """Return the topics with their types and message counts."""
        return list(self._reader.connections)

    @property
    def start(self) -> int:
        """Return the time of the first message, ns."""
        return int(self._reader.start_time)

    @property
    def seconds(self) -> float:
        """Return the time from the first message to the last, s."""
        # rosbags counts to one nanosecond after the last message.
        return max(0, int(self._reader.duration) - 1) / 1e9 if self._reader.message_count else 0.0

    def messages(self, connections: Collection[Connection] | None = None) -> Iterator[tuple[Connection, int, bytes]]:
        """Iterate over messages in order of time; messages of the same time keep their recorded order.

        Args:
            connections: topics to read; all if None.

        Yields:
            Topic, time in ns, and serialised message.

        Raises:
            BagError: the file is damaged, or decompresses to more than the limit.
        """
        if connections is not None and not connections:
            return
        opening = Opening(self._size)
        messages = self._reader.messages(connections=connections or ())
        while True:
            try:
                with opening.counting():
                    connection, time, raw = next(messages)
                if not isinstance(raw, bytes | memoryview) or not 0 <= time < MAX_TIME:
                    raise ValueError(f"a message of {printable(connection.topic)} at {printable(time)} ns")
            except StopIteration:
                return
            except Exception as error:
                raise self._damaged(error) from None
            yield connection, int(time), bytes(raw)

    def message(self, connection: Connection, raw: bytes) -> Any:
        """Deserialise a message.

        Raises:
            BagError: the bytes do not match the type of the topic.
        """
        try:
            # A sequence cannot have more elements than the message has bytes.
            self._reader.typestore.max_sequence_length = max(len(raw), 1)
            return self._reader.deserialize(raw, connection.msgtype)
        except Exception as error:
            raise self._damaged(error) from None

    def stamp(self, connection: Connection, raw: bytes) -> int:
        """Stamp in a serialised message's header, ns, without deserialising the rest, or 0; errors as in `message`.

        Raises:
            BagError: the bytes do not match the type of the topic.
        """
        fields = dict(self._reader.typestore.fielddefs[connection.msgtype][1])
        if "header" not in fields:
            return 0
        if next(iter(fields)) != "header" or fields["header"][1] != "std_msgs/msg/Header":
            return stamp_of(self.message(connection, raw))
        ros2 = self._reader.is2
        try:  # before it: of CDR the byte order, of ROS 1 the sequence number
            order = ">" if ros2 and not raw[1] & 1 else "<"
            seconds, nanoseconds = struct.unpack_from(f"{order}{'i' if ros2 else 'I'}I", raw, 4)
        except (struct.error, IndexError) as error:
            raise self._damaged(error) from None
        return int(seconds) * 10**9 + int(nanoseconds)

    def decoded(self, connections: Collection[Connection]) -> Iterator[tuple[Connection, int, Any]]:
        """Iterate over topic, time in ns, and deserialised message as `messages` does; errors as in `message`, too.

        Raises:
            BagError: the file is damaged, or the bytes do not match the type of the topic.
        """
        for connection, time, raw in self.messages(connections):
            yield connection, time, self.message(connection, raw)

    def of_type(self, message_type: str) -> list[Connection]:
        """Return the topics of one message type."""
        return [connection for connection in self._reader.connections if connection.msgtype == message_type]

    def __enter__(self) -> BagReader:
        return self

    def __exit__(self, *_: object) -> None:
        self._reader.close()


def _place_of(path: Path) -> Path:
    """The folder of a bag; of one without metadata.yaml, the only file in it."""
    folder = path.parent if path.suffix in _STORAGE and path.is_file() else path
    if (folder / "metadata.yaml").exists() or not folder.is_dir():
        return folder
    files = [path] if folder != path else [file for file in sorted(path.iterdir()) if file.suffix in _STORAGE]
    return files[0] if len(files) == 1 else folder


def _check_finished(path: Path) -> None:
    if not path.exists():
        if partial_path(path).exists():
            raise BagError(
                f"{path} was never finished: `{ds_command('bag', 'recover', path, '--out', 'DIR')}` recovers what was "
                "written"
            )
        raise BagError(f"{path}: no such bag: give the folder of a bag")
    if path.is_dir() and not (path / "metadata.yaml").exists():
        if list(path.glob("*.mcap")):
            raise BagError(
                f"{path} has no metadata.yaml: `{ds_command('bag', 'recover', path, '--out', 'DIR')}` completes it"
            )
        raise BagError(f"{path} is no bag: expected a folder with metadata.yaml")


def _check_first_line(file: Path) -> None:
    """Refuse what is no ROS 1 bag before `rosbags` reads its first line, however long it is."""
    with open_regular(file) as stream:
        if stream.read(len(ROS1_MAGIC)) != ROS1_MAGIC:
            raise ValueError("no ROS 1 bag of version 2.0")


def _check_tables(file: Path) -> None:
    """Refuse SQLite files with views, virtual tables or generated columns: a view can have endless rows."""
    database = sqlite3.connect(f"file:{quote(str(file.resolve()))}?mode=ro&immutable=1", uri=True)
    try:
        for kind, name, sql in database.execute("SELECT type, name, sql FROM sqlite_master"):
            text = str(sql or "").upper()
            if kind not in ("table", "index") or "VIRTUAL TABLE" in text or "GENERATED" in text or " AS (" in text:
                raise BagError(f"{file} has a {printable(kind)} {printable(name)!r} that no recorder makes")
        columns = "SELECT p.hidden FROM sqlite_master m, pragma_table_xinfo(m.name) p WHERE m.type = 'table'"
        if any(hidden for (hidden,) in database.execute(columns)):
            raise BagError(f"{file} has a generated column that no recorder makes")
    finally:
        database.close()


@dataclass(frozen=True, kw_only=True)
class RecordedRun:
    """Run read from a bag.

    Attributes:
        run: road, seed, observations without images, commands, and outcome.
        simulator: name for `ds_sim.registry.make_simulator`; shipped, or confirmed by the user.
        driver: name of the driver, or "".
        namespace: ROS namespace of the simulator.
        stamps: stamp of each observation, ns.
    """

    run: RunRecord
    simulator: SimulatorName
    driver: str
    namespace: str
    stamps: list[int]


def states_and_commands(bag: BagReader) -> Iterator[tuple[bool, int, Any]]:
    """Iterate over states and commands of this project's runs: whether it is a command, its stamp, ns, and message."""
    for connection, _, message in bag.decoded([*bag.of_type(STATE), *bag.of_type(DRIVE)]):
        yield connection.msgtype == DRIVE, stamp_of(message), message


def read_run(
    bag: BagReader, *, simulator: SimulatorName | None = None, seed: int | None = None, trusted: Collection[str] = ()
) -> RecordedRun:
    """Read the one run that a bag of this project holds.

    `rosbags-convert` and `ros2 bag convert` drop a bag's custom data. The road is then taken from its message;
    no message holds simulator and seed, so the caller has to give them.

    Args:
        bag: open bag.
        simulator: simulator named by the user; replaces a lost one, and is trusted if the bag names the same.
        seed: seed that replaces a lost one.
        trusted: user-provided simulators that the bag may name; their code runs when they are created.

    Raises:
        BagError: the bag holds no run or several, is not consistent, or lacks something.
        ds_sim.registry.UntrustedSimulatorError: the bag names a simulator that is neither shipped nor confirmed.
    """
    states = bag.of_type(STATE)
    if len(states) != 1:
        runs = "no run" if not states else "several runs"
        raise BagError(f"{bag.path} holds {runs} of this project: `ds bag info` lists its topics")
    facts = _completed(bag, simulator, seed)
    recorded = received_simulator(facts["simulator"], confirmed=[*trusted, *([simulator] if simulator else [])])
    observations: list[Observation] = []
    stamps: list[int] = []
    commands: dict[int, Command] = {}
    try:
        conditions = parse_conditions(facts.get("conditions", ""))
        scenario = Scenario(_road(bag, facts), conditions, seed=_seed(facts["seed"]))
        run = RunRecord(scenario=scenario, message=facts.get("message", ""))
        for is_command, stamp, message in states_and_commands(bag):
            if is_command:
                commands.setdefault(stamp, Command(message.steering, message.throttle))
            elif not stamps or stamp > stamps[-1]:  # nodes resend the first frame until it is answered
                observations.append(_observation(message))
                stamps.append(stamp)
        outcome = facts.get("outcome", "RUNNING")
        run.outcome = Outcome[outcome] if outcome in Outcome.__members__ else Outcome.RUNNING
    except BagError:
        raise
    except (RoadError, CommandError, ValueError, AttributeError, KeyError, TypeError, OverflowError) as error:
        raise _inconsistent(bag, printable(error)) from None
    if not observations:
        raise _inconsistent(bag, "no states")
    if [observation.step for observation in observations] != list(range(len(observations))):
        raise _inconsistent(bag, "gaps between its states")
    run.observations = observations
    answered = [stamp for stamp in stamps if stamp in commands]
    if answered != stamps[: len(answered)] or len(answered) < len(stamps) - 1:
        raise _inconsistent(bag, f"{len(stamps)} states, but commands for {len(answered)} of them")
    run.commands = [commands[stamp] for stamp in answered]
    if facts.get("steps", str(run.steps)) != str(run.steps):
        raise _inconsistent(bag, f"{run.steps} commands, but {printable(facts['steps'])} steps in its custom data")
    return RecordedRun(
        run=run,
        simulator=recorded,
        driver=facts.get("driver", ""),
        namespace=states[0].topic.removesuffix("/state"),
        stamps=stamps,
    )


def _inconsistent(bag: BagReader, reason: str) -> BagError:
    return BagError(f"{bag.path} is not consistent ({reason}): copy it again, or record it again")


def _completed(bag: BagReader, simulator: SimulatorName | None, seed: int | None) -> dict[str, str]:
    """Return the facts of a bag, completed with what the user gives for lost ones."""
    facts = dict(bag.facts)
    if simulator and "simulator" not in facts:
        facts["simulator"] = simulator
    if seed is not None and "seed" not in facts:
        facts["seed"] = str(seed)
    missing = [name for name in ("simulator", "seed") if name not in facts]
    if "road" not in facts and not bag.of_type(ROAD):
        missing.append("road")
    if missing:
        options = {"simulator": "--sim NAME", "seed": "--seed N"}
        arguments = " ".join(options[name] for name in missing if name in options)
        remedy = "redrive the bag it was converted from" if "road" in missing else f"give {arguments}"
        raise BagError(
            f"{bag.path} does not say its {', '.join(missing)}: custom data is lost, probably in a conversion: {remedy}"
        )
    return facts


def _road(bag: BagReader, facts: dict[str, str]) -> Road:
    """Read the road from the custom data, or else from the first road message."""
    if "road" in facts:
        return road_from_json(load_json(facts["road"]))
    for _, _, message in bag.decoded(bag.of_type(ROAD)):
        return road_from_message(message)
    raise RoadError("no road")


def _seed(text: str) -> int:
    if not (text.isascii() and text.isdigit() and len(text) < 20 and int(text) <= MAX_SEED):
        raise ValueError(f"seed {printable(text, 60)!r}, expected a whole number from 0 to {MAX_SEED}")
    return int(text)


def stamp_of(message: Any) -> int:
    """Return the stamp in the header of a message, ns; a BagError if it has none of ROS time."""
    try:
        stamp = message.header.stamp
        time = int(stamp.sec) * 10**9 + int(stamp.nanosec)
    except (AttributeError, TypeError, ValueError, OverflowError):
        raise BagError("a message has no header with a stamp: it was not recorded from ROS") from None
    if not -MAX_TIME <= time < MAX_TIME:
        raise BagError("a message has a stamp outside the range of ROS time: it was not recorded from ROS")
    return time


def _observation(state: Any) -> Observation:
    return Observation(
        image=NO_IMAGE,
        step=int(state.step),
        time=_finite(state, "simulated_time"),
        vehicle=VehicleState(**{name: _finite(state, name) for name in VehicleState.__dataclass_fields__}),
        lane=LaneState(**{name: _finite(state, name) for name in LaneState.__dataclass_fields__}),
        outcome=Outcome(int(state.outcome.value)),
    )


def _finite(state: Any, name: str) -> float:
    value = float(getattr(state, name))
    if not math.isfinite(value):
        raise ValueError(f"{name} is {value} in a state")
    return value
