"""One rosbag2 folder per run: metadata version 9, MCAP storage, as ROS 2 Jazzy writes it, and without a ROS install."""

from __future__ import annotations

import json
import os
import shutil
from functools import lru_cache
from pathlib import Path
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from ds_orchestrator.rosbag2_writer import Rosbag2Writer
from ds_sim.session import RunRecord
from ds_sim.simulator import Observation

_MESSAGES = ("Outcome", "Road", "VehicleState", "DriveCommand")
_CHANNELS = (
    ("Road", "road", 1, True),
    ("VehicleState", "state", 50, False),
    ("DriveCommand", "drive", 10, False),
    ("Outcome", "outcome", 1, True),
)
"""Message, topic, depth and latching of what a bag of level `telemetry` holds."""


class BagError(ValueError):
    """A bag that cannot be written."""


@lru_cache(maxsize=1)
def typestore() -> Typestore:
    """Jazzy's standard messages and ours, the latter from their installed definitions.

    Raises:
        BagError: the workspace's messages are not on AMENT_PREFIX_PATH.
    """
    store = get_typestore(Stores.ROS2_JAZZY)
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        folder = Path(prefix) / "share" / "ds_interfaces" / "msg"
        if (folder / "Road.msg").exists():
            types: dict[str, Any] = {}
            for name in _MESSAGES:
                types.update(get_types_from_msg((folder / f"{name}.msg").read_text(), f"ds_interfaces/msg/{name}"))
            store.register(types)
            return store
    raise BagError("ds_interfaces is not on AMENT_PREFIX_PATH: build the workspace and source its setup file")


def write_bag(folder: Path, namespace: str, run: RunRecord, about: dict[str, str]) -> None:
    """Write one run at level `telemetry`: road, states, commands, outcome; stamps count from the start of the run.

    Args:
        folder: the bag; it appears whole or not at all, and replaces one that is there.
        namespace: of the simulator, such as `/ds1`.
        run: what happened.
        about: facts for the bag's custom data, beside road, seed and outcome, which are always there.

    Raises:
        BagError: the folder cannot be written.
    """
    # The files inside are named after their folder, so the unfinished one has that name too, a level deeper.
    hidden = folder.with_name(f".{folder.name}.partial")
    try:
        shutil.rmtree(hidden, ignore_errors=True)
        _write(hidden / folder.name, namespace, run, about)
        shutil.rmtree(folder, ignore_errors=True)
        (hidden / folder.name).rename(folder)
        hidden.rmdir()
    except OSError as error:
        raise BagError(f"bag {folder} cannot be written ({error.strerror}): check the disk and the folder") from None


def _write(path: Path, namespace: str, run: RunRecord, about: dict[str, str]) -> None:
    store = typestore()
    types: Any = store.types
    writer = Rosbag2Writer(path, store)
    try:
        channels = {
            name: writer.channel(f"{namespace}/{topic}", f"ds_interfaces/msg/{name}", depth=depth, latched=latched)
            for name, topic, depth, latched in _CHANNELS
        }

        def put(name: str, time: float, **fields: Any) -> None:
            writer.write(channels[name], round(time * 1e9), types[f"ds_interfaces/msg/{name}"](**fields))

        point = types["geometry_msgs/msg/Point"]
        points = [point(x=x, y=y, z=0.0) for x, y in run.road.control_points]
        put("Road", 0.0, road_id=run.road.road_id, control_points=points)
        for index, observation in enumerate(run.observations):
            time, header = observation.time, _header(types, observation.time)
            value = types["ds_interfaces/msg/Outcome"](value=int(observation.outcome))
            state = _state_fields(observation)
            put("VehicleState", time, header=header, road_id=run.road.road_id, outcome=value, **state)
            if index < len(run.commands):
                command = run.commands[index]
                put("DriveCommand", time, header=header, steering=command.steering, throttle=command.throttle)
        put("Outcome", run.simulated_seconds, value=int(run.outcome))
        facts = {
            "road": json.dumps(run.road.control_points),
            "road_id": run.road.road_id,
            "seed": str(run.seed),
            "outcome": run.outcome.name,
            "message": run.message,
        }
        writer.close(facts | about)
    except BaseException:
        writer.abort()
        raise


def _header(types: Any, time: float) -> Any:
    nanoseconds = round(time * 1e9)
    stamp = types["builtin_interfaces/msg/Time"](sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
    return types["std_msgs/msg/Header"](stamp=stamp, frame_id="road")


def _state_fields(observation: Observation) -> dict[str, Any]:
    vehicle, lane = observation.vehicle, observation.lane
    return {
        "step": observation.step,
        "simulated_time": observation.time,
        **{name: getattr(vehicle, name) for name in vehicle.__dataclass_fields__},
        **{name: getattr(lane, name) for name in lane.__dataclass_fields__},
    }
