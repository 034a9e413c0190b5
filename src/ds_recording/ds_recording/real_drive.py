# SPDX-License-Identifier: Apache-2.0
"""Reads the outcome of one real drive from a recording: a bag, a located recording, or a tub with a verdict."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import reduce
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ds_bags.donkey_tub import is_tub, read_tub
from ds_bags.reader import BagReader
from ds_recording import RecordingError
from ds_recording.located import LOCATED, read_located
from ds_recording.sibling.recorded_drive import driven_side
from ds_road import Road
from ds_sim.oracle import LaneTracker, OracleLimits

Array = NDArray[np.float64]
ODOMETRY = "nav_msgs/msg/Odometry"
WHOLE = 0.95
"""Share of the lane that a completed drive covers; chosen: a person lifts the car off shortly before the end."""
_LONGEST_GAP = 4.0
"""m of the road between two positions: half of what a lane's tracker searches; beyond, the odometry jumps."""


@dataclass(frozen=True, kw_only=True)
class RecordedOutcome:
    """What a recording says about a drive."""

    # Largest absolute lateral position until the car leaves its lane, m of the road frame; None if the recording does
    # not tell.
    lateral: float | None
    share: float | None  # share of the lane that was driven; None if it does not tell
    when: str  # time of its first message, ISO 8601, UTC

    def outcome(self, half_lane: float) -> str | None:
        """The outcome that follows from the recording; None if it takes a person to say."""
        if self.lateral is not None and self.lateral > half_lane:
            return "out_of_bounds"
        return "completed" if self.share is not None and self.share >= WHOLE else None


def is_recording(path: Path) -> bool:
    """Whether a path is a bag or a tub, and not a CSV."""
    return path.is_dir() or path.suffix in (".mcap", ".db3", ".bag")


def read_recording(path: Path, road: Road, *, scale: float, topic: str | None = None) -> RecordedOutcome:
    """Read a rosbag2 folder, a tub, or a folder of `ds recording locate`, of a drive on one road.

    A metre of the car's is `scale` metres of the road. The topic is `TOPIC:FIELD` of the lateral position in metres of
    the car's, or that of odometry which begins at the start of the road; the only odometry of a bag if None.
    RecordingError if there is no such topic, or odometry that jumps; BagError or TubError if a file is damaged.
    """
    if is_tub(path):
        return RecordedOutcome(lateral=None, share=None, when=_began(path))
    if (path / LOCATED).is_file():
        return _located(path, road, scale)
    with BagReader(path) as bag:
        when = _said(bag.start / 1e9)
        if topic is not None and ":" in topic:
            values = _values(bag, topic)
            return RecordedOutcome(lateral=max(map(abs, values)) * scale, share=None, when=when)
        lateral, share = _along(road, _poses(bag, topic), scale, path)
        return RecordedOutcome(lateral=lateral, share=share, when=when)


def _began(path: Path) -> str:
    """Time of the first record of a tub, or of the first message of a bag."""
    if not is_tub(path):
        with BagReader(path) as bag:
            return _said(bag.start / 1e9)
    records = read_tub(path).records
    if not records:
        raise RecordingError(f"{path}: a tub without records")
    return _said(records[0].seconds)


def _located(path: Path, road: Road, scale: float) -> RecordedOutcome:
    """What the images of a drive say: the way along the lines that they show, and the offset from the lane driven."""
    located = read_located(path)
    offsets = np.abs(located.column("lateral_m") - driven_side(located)) * scale
    beyond = np.flatnonzero(offsets > road.lane_width / 2)
    end = int(beyond[0]) + 1 if beyond.size else len(offsets)
    along = located.column("along_m")[:end] * scale
    whole = LaneTracker(road.lane_centre).length - OracleLimits().finish_margin  # where a simulated drive ends, too
    share = min(float(along.max() - along.min()) / whole, 1.0)
    return RecordedOutcome(
        lateral=float(offsets[:end].max()), share=share, when=_began(path / str(located.about.get("source")))
    )


def _said(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="seconds")


def _values(bag: BagReader, topic: str) -> list[float]:
    name, _, path = topic.partition(":")
    connections = [connection for connection in bag.connections if connection.topic == name]
    if not connections:
        topics = ", ".join(sorted({connection.topic for connection in bag.connections}))
        raise RecordingError(f"{bag.path} has no topic {name!r:.80}, expected one of {topics}")
    values = []
    for connection, _, raw in bag.messages(connections):
        try:
            values.append(float(reduce(getattr, path.split("."), bag.message(connection, raw))))
        except (AttributeError, TypeError, ValueError):
            raise RecordingError(f"{bag.path}: {connection.msgtype} has no number {path!r:.80}") from None
    if not (finite := list(filter(math.isfinite, values))):
        raise RecordingError(f"{bag.path}: {topic} has no finite value")
    return finite


def _poses(bag: BagReader, topic: str | None) -> Array:
    """(n, 3) x, y and yaw of the odometry."""
    connections = [one for one in bag.of_type(ODOMETRY) if topic in (None, one.topic)]
    if len({one.topic for one in connections}) != 1:
        topics = ", ".join(sorted({one.topic for one in bag.of_type(ODOMETRY)})) or "none"
        raise RecordingError(
            f"{bag.path}: name one topic of odometry (it has {topics}) or of a lateral position: --topic"
        )
    poses = []
    for _, _, message in bag.decoded(connections):
        pose = message.pose.pose
        q = pose.orientation
        yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y**2 + q.z**2))
        if all(map(math.isfinite, (pose.position.x, pose.position.y, yaw))):
            poses.append((pose.position.x, pose.position.y, yaw))
    if len(poses) < 2:
        raise RecordingError(f"{bag.path}: {len(poses)} finite positions, expected a drive")
    return np.array(poses, np.float64)


def _along(road: Road, poses: Array, scale: float, path: Path) -> tuple[float, float]:
    """Largest absolute lateral position until the car leaves the lane, m, and the share of the lane driven."""
    lane = road.lane_centre
    ahead = lane[1] - lane[0]
    turn = math.atan2(ahead[1], ahead[0]) - poses[0, 2]
    rotation = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    positions = lane[0] + scale * (poses[:, :2] - poses[0, :2]) @ rotation.T
    gaps = np.hypot(*np.diff(positions, axis=0).T)
    if gaps.max() > _LONGEST_GAP:
        raise RecordingError(
            f"{path}: the odometry jumps by {gaps.max() / scale:.2f} m: expected a drive in metres of the car's"
        )
    tracker = LaneTracker(lane)
    largest, arc = 0.0, 0.0
    for x, y in positions:
        lateral, place = tracker.update(float(x), float(y))
        if place > tracker.length:
            break  # past the end
        largest, arc = max(largest, abs(lateral)), max(arc, place)
        if largest > road.lane_width / 2:
            break
    return largest, arc / tracker.length
