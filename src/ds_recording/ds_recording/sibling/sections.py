# SPDX-License-Identifier: Apache-2.0
"""Roads to test on a recorded track: sections of the lane that was driven."""

from __future__ import annotations

import numpy as np

from ds_recording.errors import RecordingError
from ds_recording.sibling.recorded_drive import RecordedDrive, near_photographs
from ds_recording.track import Track, wrap
from ds_road import Road, RoadError

TOLERANCE = 0.3
"""Distance, road metres, by which a lane may differ from the one that was driven; chosen: a thirteenth of its width."""

EVERY, ENOUGH = 20.0, 20
"""Distance between two starts, road metres, shortened for at least so many roads; chosen: enough to judge a sibling."""


LENGTH = 80.0
"""Usual length of a road, road metres; chosen: the roads of a campaign have 60 to 150."""


def sections(drive: RecordedDrive, length: float, every: float | None = None) -> list[Road]:
    """Cut the driven lane into overlapping roads, each driven in its right lane, where there are photographs.

    `length` is that of each road, `every` the distance between two starts, road metres; None for `EVERY`, or less where
    the track is short.

    Raises:
        RecordingError: none of them is a valid road, as on a lap that is shorter.
    """
    lane = drive.lane
    shown = near_photographs(lane.points, drive.poses)
    count = round(length) + 1
    last = len(lane.points) if lane.closed else len(lane.points) - count + 1
    step = max(round(EVERY if every is None else every), 1)
    roads: list[Road] = []
    reasons = ["" if last > 0 else "it is longer than the lane"]
    while True:
        for start in range(0, max(last, 0), step):
            part = (start + np.arange(count)) % len(lane.points)
            centre = Track(lane.points[part]).beside(-drive.lane_width / 2)
            road = Road.from_road_points(centre.points.round(4), lane_width=drive.lane_width)
            if shown[part].all() and road.validity.valid:
                roads.append(road)
            else:
                reasons.append(road.validity.reason or "photographs are missing")
        if every is not None or len(roads) >= ENOUGH or step == 1:
            break
        step, roads = step // 2, []
    if not roads:
        raise RecordingError(
            f"no section of {length:g} road metres is a valid road, the lane has {lane.length:.0f}: of the last one, "
            f"{reasons[-1]}; shorten --length, or locate another part of the recording"
        )
    return roads


def check_is_section(road: Road, drive: RecordedDrive) -> None:
    """Check that a road lies on the recorded track, in its direction and lane; RoadError if it does not."""
    lane, points = road.lane_centre, drive.lane.points
    nearest = np.array([int(np.argmin((points[:, 0] - x) ** 2 + (points[:, 1] - y) ** 2)) for x, y in lane.tolist()])
    pieces = drive.lane.nearest(lane, nearest)
    _, offset, heading = drive.lane.place(lane, pieces)
    ahead = lane[1] - lane[0]
    same_way = np.cos(heading[0]) * ahead[0] + np.sin(heading[0]) * ahead[1] > 0.0
    if np.abs(offset).max() > TOLERANCE or np.hypot(*(lane - points[nearest]).T).max() > 2.0 or not same_way:
        raise RoadError(
            f"road {road.road_id} is no section of the recorded track: make roads with `ds recording roads`"
        )


def left_its_lane(drive: RecordedDrive, road: Road) -> bool:
    """Whether the recorded car left the lane of a section of its track, on any lap."""
    line, places = Track(road.lane_centre), drive.poses[:, :2]
    nearest = np.array([int(np.argmin(np.hypot(*(line.points - place).T))) for place in places])
    along, offset, heading = line.place(places, line.nearest(places, nearest))
    here = (along > 0.0) & (along < line.length) & (np.abs(wrap(drive.poses[:, 2] - heading)) < np.pi / 2)
    here &= np.abs(offset) < 1.5 * road.lane_width  # not another part of the track
    return bool((np.abs(offset[here]) > road.lane_width / 2).any())
