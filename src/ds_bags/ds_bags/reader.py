"""Reads bags, ours and anybody's: rosbag2 folders with MCAP or SQLite files, and ROS 1 `.bag` files."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import yaml
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection
from rosbags.typesys import Stores, get_typestore

from ds_bags.layout import BagError, image_spool_path, partial_path
from ds_road import Road, RoadError
from ds_sim.session import RunRecord
from ds_sim.simulator import Command, CommandError, LaneState, Observation, Outcome, VehicleState

_NO_IMAGE = np.empty((0, 0, 3), np.uint8)
STATE, DRIVE = "ds_interfaces/msg/VehicleState", "ds_interfaces/msg/DriveCommand"


class BagReader:
    """An open bag.

    Args:
        path: folder of a rosbag2, or a ROS 1 `.bag` file.

    Raises:
        BagError: there is none, it was never finished, or it is damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.parent if path.suffix in (".mcap", ".db3") and path.is_file() else path
        _check_finished(self.path)
        try:
            self._reader = AnyReader([self.path], default_typestore=get_typestore(Stores.ROS2_JAZZY))
            self._reader.open()
        except Exception as error:  # a damaged file raises whatever its reader stumbles on
            raise self._damaged(error) from None
        self.facts = _facts(self.path)

    def _damaged(self, error: Exception) -> BagError:
        text = " ".join(str(error).split()) or type(error).__name__
        return BagError(f"{self.path} cannot be read ({text}): try `ds bag recover {self.path} --out DIR`")

    @property
    def connections(self) -> list[Connection]:
        """Topics with types and counts."""
        return list(self._reader.connections)

    @property
    def start(self) -> int:
        """Time of the first message, ns."""
        return int(self._reader.start_time)

    @property
    def seconds(self) -> float:
        """From the first message to the last."""
        # rosbags counts to the nanosecond after the last message.
        return max(0, int(self._reader.duration) - 1) / 1e9 if self._reader.message_count else 0.0

    def messages(self, connections: Collection[Connection] | None = None) -> Iterator[tuple[Connection, int, bytes]]:
        """Topic, time in ns, and serialised message, in the order of time; those of one time as they were recorded.

        Args:
            connections: only these; all if None.

        Raises:
            BagError: the file is damaged.
        """
        if connections is not None and not connections:
            return
        found = self._reader.messages(connections=connections or ())
        while True:
            try:
                connection, time, raw = next(found)
            except StopIteration:
                return
            except Exception as error:
                raise self._damaged(error) from None
            yield connection, time, bytes(raw)

    def message(self, connection: Connection, raw: bytes) -> Any:
        """A message as an object.

        Raises:
            BagError: the bytes are not of its type.
        """
        try:
            return self._reader.deserialize(raw, connection.msgtype)
        except Exception as error:
            raise self._damaged(error) from None

    def of_type(self, message_type: str) -> list[Connection]:
        """Topics of a type."""
        return [connection for connection in self._reader.connections if connection.msgtype == message_type]

    def __enter__(self) -> BagReader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._reader.close()


def _check_finished(path: Path) -> None:
    if not path.exists():
        if partial_path(path).exists() or image_spool_path(path).exists():
            raise BagError(f"{path} was never finished: `ds bag recover {path} --out DIR` makes a bag of what is there")
        raise BagError(f"{path}: no such bag: give the folder of one")
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        if list(path.glob("*.mcap")):
            raise BagError(f"{path} has no metadata.yaml: `ds bag recover {path} --out DIR` makes a whole bag of it")
        raise BagError(f"{path} is no bag: expected a folder with metadata.yaml")


def _facts(path: Path) -> dict[str, str]:
    """The custom data of a bag; empty if it has none."""
    if not path.is_dir():
        return {}
    information = yaml.safe_load((path / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    return {str(key): str(value) for key, value in (information.get("custom_data") or {}).items()}


@dataclass(frozen=True, kw_only=True)
class RecordedRun:
    """A run as a bag of ours tells it.

    Attributes:
        run: road, seed, observations without images, commands, outcome.
        simulator: as the registry knows it.
        driver: who drove.
        namespace: of the simulator.
        stamps: of the observations, ns.
    """

    run: RunRecord
    simulator: str
    driver: str
    namespace: str
    stamps: list[int]


def read_run(bag: BagReader) -> RecordedRun:
    """The run that a bag of ours holds.

    Raises:
        BagError: it holds none, more than one, or one that does not fit together.
    """
    states, drives = bag.of_type(STATE), bag.of_type(DRIVE)
    if len(states) != 1 or not {"simulator", "road", "seed"} <= bag.facts.keys():
        raise BagError(f"{bag.path} is no bag of one run of ours: `ds bag info` says what it holds")
    observations: list[Observation] = []
    stamps: list[int] = []
    told: dict[int, Command] = {}
    try:
        road = Road(json.loads(bag.facts["road"]))
        for connection, _, raw in bag.messages([*states, *drives]):
            message = bag.message(connection, raw)
            stamp = stamp_of(message)
            if connection.msgtype == DRIVE:
                told.setdefault(stamp, Command(message.steering, message.throttle))
            elif not stamps or stamp > stamps[-1]:  # the first frame is sent again until it is answered
                observations.append(_observation(message))
                stamps.append(stamp)
        seed, outcome = int(bag.facts["seed"]), bag.facts.get("outcome", "RUNNING")
        run = RunRecord(road=road, seed=seed, message=bag.facts.get("message", ""))
        run.outcome = Outcome[outcome] if outcome in Outcome.__members__ else Outcome.RUNNING
    except (RoadError, CommandError, ValueError, AttributeError, KeyError) as error:
        raise BagError(f"{bag.path} does not hold together ({error}): record it again") from None
    if [seen.step for seen in observations] != list(range(len(observations))):
        raise BagError(f"{bag.path} has gaps between its states: record it again")
    run.observations = observations
    answered = [stamp for stamp in stamps if stamp in told]
    if answered != stamps[: len(answered)] or len(answered) < len(stamps) - 1:
        raise BagError(
            f"{bag.path} has {len(stamps)} states, but commands for {len(answered)} of them: record it again"
        )
    run.commands = [told[stamp] for stamp in answered]
    return RecordedRun(
        run=run,
        simulator=bag.facts["simulator"],
        driver=bag.facts.get("driver", ""),
        namespace=states[0].topic.removesuffix("/state"),
        stamps=stamps,
    )


def stamp_of(message: Any) -> int:
    """Of a message with a header, ns."""
    stamp = message.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def _observation(state: Any) -> Observation:
    return Observation(
        image=_NO_IMAGE,
        step=int(state.step),
        time=float(state.simulated_time),
        vehicle=VehicleState(**{name: float(getattr(state, name)) for name in VehicleState.__dataclass_fields__}),
        lane=LaneState(**{name: float(getattr(state, name)) for name in LaneState.__dataclass_fields__}),
        outcome=Outcome(int(state.outcome.value)),
    )
