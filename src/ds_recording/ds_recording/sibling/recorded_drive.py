# SPDX-License-Identifier: Apache-2.0
"""A located recording in road metres: photographs with their poses, the camera, the lane, and roads to test on it."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ds_bags.donkey_tub import TubError, is_tub, read_tub
from ds_bags.layout import BagError
from ds_base.bounded_file import FileError, read_regular
from ds_driver.data.recordings import Reading, open_recording
from ds_driver.networks.images import MAX_IMAGE_FILE, ImageError, rgb_of_file
from ds_recording import RecordingError
from ds_recording.floor_camera import FloorCamera
from ds_recording.located import ABOUT, CAMERA, LOCATED, MAX_FILE, TRACK, Located, read_located
from ds_recording.track import Track, wrap
from ds_road import Road, RoadError
from ds_road.geometry import BOX
from ds_sim.camera.encodings import png
from ds_twin_donkey.parameters import SCALE

Array = NDArray[np.float64]
LANES = (1.0 / SCALE, 20.0 / SCALE)
"""Least and largest lane width, m on the floor: a road's lanes are 1 to 20 road metres wide."""
NEAR = 3.0
"""Largest distance from a point of the lane to a photograph, road metres; chosen: what the sibling's camera bears."""
SPACING = 1.0
"""Step of the driven lane's centre line, road metres; chosen: fine enough for the tightest bend of a track."""


@dataclass(frozen=True, kw_only=True)
class RecordedDrive:
    """What the sibling knows of a recording, in road metres (16 to a metre on the floor), in the road's box."""

    poses: Array  # x, y (m) and yaw (rad) of the car's centre at each photograph, (n, 3)
    photographs: tuple[bytes, ...]  # as JPEG or PNG files, in the same order
    camera: FloorCamera
    lane: Track  # centre line of the lane that was driven
    lane_width: float  # m
    sha256: str  # of the poses, the track and the camera

    def photograph(self, index: int) -> NDArray[np.uint8]:
        """Photograph, (rows, columns, 3) uint8 RGB."""
        try:
            image = rgb_of_file(self.photographs[index])
        except ImageError as error:
            raise RecordingError(f"photograph {index} of the recording: {error}: copy the recording again") from None
        if image.shape[:2] != (self.camera.height_px, self.camera.width_px):
            raise RecordingError(
                f"photograph {index} of the recording has {image.shape[1]} x {image.shape[0]} px, expected "
                f"{self.camera.width_px} x {self.camera.height_px} as {CAMERA} has it: locate the recording again"
            )
        return image


def read_drive(folder: Path) -> RecordedDrive:
    """Read the folder that `ds recording locate` wrote, and find the recording's photographs; or RecordingError."""
    located = read_located(folder)
    width = located.lane_width
    if not LANES[0] <= width <= LANES[1]:
        raise RecordingError(
            f"{folder / ABOUT}: a lane of {width:g} m, expected {LANES[0]:g} to {LANES[1]:g}, as this sibling's car "
            "is a 1:16 one: locate the recording with --lane-width as measured on the floor"
        )
    if not located.camera.mounted:
        raise RecordingError(f"{folder / CAMERA}: height_m and pitch_rad are missing: locate the recording again")
    files = _photographs(folder, located)
    frames = located.column("frame").astype(int).tolist()
    if missing := [frame for frame in frames if frame not in files]:
        raise RecordingError(f"{folder / LOCATED}: the recording has no image {missing[0]}: locate it again")
    lane = located.track.beside(driven_side(located))
    points = lane.points * SCALE
    shift = BOX / 2 - (points.min(axis=0) + points.max(axis=0)) / 2
    xy = np.stack((located.column("x_m"), located.column("y_m")), axis=1) * SCALE + shift
    digest = hashlib.sha256()
    for name in (LOCATED, TRACK, CAMERA):
        digest.update(read_regular(folder / name, MAX_FILE))
    return RecordedDrive(
        poses=np.column_stack((xy, located.column("yaw_rad"))),
        photographs=tuple(files[frame] for frame in frames),
        camera=located.camera.scaled(SCALE),
        lane=_with_photographs(Track(points + shift, lane.closed).resampled(SPACING), xy),
        lane_width=width * SCALE,
        sha256=digest.hexdigest(),
    )


def near_photographs(points: Array, poses: Array) -> NDArray[np.bool_]:
    """Which points, (n, 2), have a photograph near them; both in road metres."""
    return np.asarray(KDTree(poses[:, :2]).query(points)[0] <= NEAR)


def _with_photographs(lane: Track, poses: Array) -> Track:
    """An open lane without the ends that were seen but not driven."""
    if lane.closed:
        return lane
    shown = np.flatnonzero(near_photographs(lane.points, poses))
    return Track(lane.points[shown[0] : shown[-1] + 1] if shown.size > 1 else lane.points)


def _photographs(folder: Path, located: Located) -> dict[int, bytes]:
    """Encoded photographs by their index in the recording; those of a bag without loss, as they may be raw there."""
    source = folder / str(located.about.get("source"))
    topic = located.about.get("topic")
    wanted = set(located.column("frame").astype(int).tolist())
    try:
        if is_tub(source):
            pictures = read_tub(source).pictures
            return {one.index: read_regular(file, MAX_IMAGE_FILE) for one, file in pictures if one.index in wanted}
        frames = open_recording(source, Reading(whole=True, camera=topic if isinstance(topic, str) else None)).frames()
        return {one.index: png(one.image) for one in frames if one.image is not None and one.index in wanted}
    except (OSError, FileError, TubError, BagError) as error:
        reason = getattr(error, "strerror", None) or error
        raise RecordingError(f"{source}: {reason}: put the recording there, or locate it again") from None


def driven_side(located: Located) -> float:
    """Distance, m to the right, from the track's line to the middle of the lane that was driven; 0 if straddled."""
    lateral = float(np.median(located.column("lateral_m")))
    return 0.0 if abs(lateral) < located.lane_width / 4 else math.copysign(located.lane_width / 2, lateral)


TOLERANCE = 0.3
"""Distance, road metres, by which a lane may differ from the one that was driven; chosen: a thirteenth of its width."""
EVERY, ENOUGH = 20.0, 20
"""Distance between two starts, road metres, shortened for at least so many roads; chosen: enough to judge a sibling."""
LENGTH = 80.0
"""Usual length of a road, road metres; chosen: the roads of a campaign have 60 to 150."""


def sections(drive: RecordedDrive, length: float, every: float | None = None) -> list[Road]:
    """Cut the driven lane into overlapping roads, each driven in its right lane, where there are photographs.

    `length` is that of each road, `every` the distance between two starts, road metres; None for `EVERY`, or less where
    the track is short. RecordingError if none is a valid road, as on a lap that is shorter.
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
