# SPDX-License-Identifier: Apache-2.0
"""Roads for a simulator that reads them from a file, and the road of one whose track is fixed."""

from __future__ import annotations

from pathlib import Path

from ds_base.atomic_files import write_json, write_whole
from ds_base.bounded_yaml import BoundedYamlError, read_bounded
from ds_road import Road, RoadError, read_roads
from ds_road.centre_lines import CentreLine
from ds_road.tracks import read_track as read_points
from ds_sim.oracle import LaneTracker
from ds_sim.road_simulator import start_of
from ds_sim_ros.settings import RosSettingsError

LARGEST = 2**20
"""Bytes of a track; chosen: a road has at most 1000 points."""
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


def read_track(path: Path, lane_width: float) -> Road:
    """Read the centre line of a fixed track: a CSV file as `ds road import` reads it, or a road file of JSON.

    Raises:
        RosSettingsError: in one line, why it is no track.
    """
    try:
        if path.suffix == ".json":
            (road,) = read_roads(path)
            return road
        return CentreLine(path.stem, read_points(read_bounded(path, LARGEST)).points, lane_width).road()
    except OSError as error:
        raise RosSettingsError(f"{path}: cannot be read ({error.strerror}): check the path") from None
    except (ValueError, BoundedYamlError) as error:
        reason = " ".join(str(error).split())
        raise RosSettingsError(f"{path}: not one track ({reason})") from None


def check_is_track(road: Road, track: Road, name: str) -> None:
    """Check that a road is the fixed track, in either lane.

    Raises:
        RoadError: it is another one.
    """
    tracker = LaneTracker(track.points)
    reached = [tracker.update(x, y) for x, y in road.points.tolist()]
    furthest = max(abs(lateral) for lateral, _ in reached)
    ends = max(abs(reached[0][1]), abs(reached[-1][1] - tracker.length))
    if max(furthest, ends, abs(road.lane_width - track.lane_width)) > TOLERANCE:
        raise RoadError(
            f"road {road.road_id} is not the track of {name}, which is fixed: drive the road that ds road import makes "
            f"of its centre_line, with --lane-width {track.lane_width:g}"
        )
