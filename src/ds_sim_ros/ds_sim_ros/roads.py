# SPDX-License-Identifier: Apache-2.0
"""Roads for a simulator that reads them from a file, and the road of one whose track is fixed."""

from __future__ import annotations

from pathlib import Path

from ds_base.folder_files import write_json, write_whole
from ds_road import Road, RoadError, Side, read_roads
from ds_road.centre_lines import in_box
from ds_road.importing import import_roads
from ds_sim.oracle import LaneTracker
from ds_sim.road_simulator import start_of
from ds_sim_ros.settings import RosSettingsError

TOLERANCE = 0.1
"""Distance, m, by which a road may differ from the fixed track; chosen: a fortieth of a lane."""


def write_road(road: Road, path: Path) -> None:
    """Write a road: a CSV file has a line `x,y` for each point of the centre line, a JSON file lane and start, too."""
    if path.suffix == ".csv":
        write_whole(path, "".join(f"{x!r},{y!r}\n" for x, y in road.points.tolist()))
        return
    x, y, yaw = start_of(road)
    write_json(
        path,
        {
            "centre_line": road.points.tolist(),
            "lane_width": road.lane_width,
            "lane": road.lane,
            "start": {"x": x, "y": y, "yaw": yaw},
        },
    )


def read_track(path: Path, lane_width: float | None, lane: Side | None) -> tuple[Road, tuple[float, float]]:
    """Read a fixed track: a file as `ds road import` reads it, or a road file of JSON; else RosSettingsError.

    The road is in the middle of the box if it was outside and fits; by how much it was moved, m, is returned, too.
    """
    try:
        if path.suffix == ".json":
            (road,) = read_roads(path)
            return in_box(road if lane is None else road.in_lane(lane))
        (track,) = import_roads(path, lane_width=lane_width, lane=lane)
        return track.road, track.moved
    except OSError as error:
        raise RosSettingsError(f"{path}: cannot be read ({error.strerror}): check the path") from None
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise RosSettingsError(f"{path}: not one track ({reason})") from None


def check_is_track(road: Road, track: Road, name: str) -> None:
    """Check that a road is the fixed track, in either lane; RoadError if it is another one."""
    tracker = LaneTracker(track.points)
    reached = [tracker.update(x, y) for x, y in road.points.tolist()]
    furthest = max(abs(lateral) for lateral, _ in reached)
    ends = max(abs(reached[0][1]), abs(reached[-1][1] - tracker.length))
    if max(furthest, ends, abs(road.lane_width - track.lane_width)) > TOLERANCE:
        raise RoadError(
            f"road {road.road_id} is not the track of {name}, which is fixed: drive the road that ds road import makes "
            "of its centre_line, or leave out the road in ds drive"
        )
