# SPDX-License-Identifier: Apache-2.0
"""Outcomes of real drives from recordings: bags of simulated drives stand in for those of a car."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from foreign_bags import foreign_bag
from tests import drives
from tubs import write_tub

from ds_bags.run_writer import write_bag
from ds_recording.errors import RecordingError
from ds_recording.floor_camera import FloorCamera
from ds_recording.located import COLUMNS, Located, write_located
from ds_recording.real_drive import is_recording, read_recording
from ds_recording.track import Track
from ds_road import Road
from ds_sim.registry import DONKEY
from ds_sim.session import RunRecord

pytestmark = pytest.mark.graph

ROAD = Road([(125.0, 20.0), (125.0, 45.0), (127.0, 70.0), (133.0, 94.0), (134.0, 119.0)])


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, RunRecord]:
    run = drives.driven("donkey", ROAD, 3)
    folder = tmp_path_factory.mktemp("real") / "bag"
    write_bag(folder, "/car", DONKEY, run, {"driver": "autopilot"})
    return folder, run


def test_odometry_gives_the_lateral_position_and_the_verdict(driven: tuple[Path, RunRecord]) -> None:
    folder, run = driven
    found = read_recording(folder, ROAD, scale=1.0)
    assert found.lateral == pytest.approx(run.max_lateral_position, abs=0.05)
    assert found.outcome(2.0) == "completed" and found.share is not None and found.share > 0.95
    assert found.when.startswith("1970-01-01T")  # simulated time
    assert is_recording(folder)


def test_a_road_with_another_bend_is_left(driven: tuple[Path, RunRecord]) -> None:
    mirrored = Road([(250.0 - x, y) for x, y in ROAD.control_points])
    found = read_recording(driven[0], mirrored, scale=1.0)
    assert found.outcome(2.0) == "out_of_bounds" and found.lateral is not None and 2.0 < found.lateral < 2.5


@pytest.mark.parametrize(("offset", "outcome", "lateral"), [(0.05, "completed", 0.8), (0.2, "out_of_bounds", 2.08)])
def test_a_located_recording_gives_the_offset_from_the_lane_driven(
    tmp_path: Path, offset: float, outcome: str, lateral: float
) -> None:
    along = np.linspace(0.0, ROAD.length / 16.0, 101)
    swerve = offset * np.sin(np.linspace(0.0, np.pi, 101)) ** 8  # the car leaves its lane and comes back
    table = np.zeros((101, len(COLUMNS)))
    table[:, COLUMNS.index("along_m")], table[:, COLUMNS.index("lateral_m")] = along, 0.125 + swerve
    camera = FloorCamera(
        width_px=160,
        height_px=120,
        focal_px=(90.0, 90.0),
        centre_x_px=79.5,
        centre_y_px=59.5,
        height_m=0.1,
        pitch_rad=0.2,
    )
    track = Track(np.column_stack((along, np.zeros(101))))
    about = {"source": "tub", "lane_width_m": 0.25}
    write_located(tmp_path, Located(table=table, track=track, lane_width=0.25, camera=camera, about=about))
    write_tub(tmp_path / "tub", [{"_timestamp_ms": 86_400_000}])
    found = read_recording(tmp_path, ROAD, scale=16.0)
    assert found.outcome(2.0) == outcome and found.lateral == pytest.approx(lateral, abs=0.09)
    assert found.when == "1970-01-02T00:00:00+00:00" and is_recording(tmp_path)


def test_a_topic_with_the_lateral_position_is_read(driven: tuple[Path, RunRecord]) -> None:
    folder, run = driven
    found = read_recording(folder, ROAD, scale=2.0, topic="/car/state:lateral_position")
    assert found.lateral == pytest.approx(2.0 * run.max_lateral_position, abs=1e-6) and found.outcome(2.0) is None
    for topic, named in (
        ("/car/nothing:x", "has no topic '/car/nothing', expected one of /car/drive"),
        ("/car/state:nothing", "has no number 'nothing'"),
        ("/car/state", "name one topic of odometry .it has /car/odom."),
    ):
        with pytest.raises(RecordingError, match=named):
            read_recording(folder, ROAD, scale=1.0, topic=topic)
    with pytest.raises(RecordingError, match="the odometry jumps"):
        read_recording(folder, ROAD, scale=30.0)


def test_a_bag_of_another_robot_is_read(tmp_path: Path) -> None:
    """Written by rosbags, in the car's metres, turned by a quarter and begun somewhere else; it stops half-way."""
    lane = ROAD.lane_centre[: len(ROAD.lane_centre) // 2]
    ahead = lane[1] - lane[0]
    heading = float(np.arctan2(ahead[1], ahead[0])) + np.pi / 2
    points = (lane - lane[0]) / 16 @ np.array([[0.0, 1.0], [-1.0, 0.0]]) + (3.0, -1.0)
    with foreign_bag(tmp_path / "bag") as bag:
        sine, cosine = float(np.sin(heading / 2)), float(np.cos(heading / 2))
        quaternion = bag.make("geometry_msgs/Quaternion", x=0.0, y=0.0, z=sine, w=cosine)
        still = bag.make("geometry_msgs/Twist", linear=bag.vector(), angular=bag.vector())
        twist = bag.make("geometry_msgs/TwistWithCovariance", twist=still, covariance=np.zeros(36))
        about = {"header": bag.header(10**9, "odom"), "child_frame_id": "base", "twist": twist}
        for k, (x, y) in enumerate(points):
            place = bag.make("geometry_msgs/Point", x=float(x), y=float(y), z=0.0)
            pose = bag.make("geometry_msgs/Pose", position=place, orientation=quaternion)
            uncertain = bag.make("geometry_msgs/PoseWithCovariance", pose=pose, covariance=np.zeros(36))
            message = bag.make("nav_msgs/Odometry", pose=uncertain, **about)
            bag.write("/odometry", 1_772_323_200_000_000_000 + k * 50_000_000, message)
    found = read_recording(tmp_path / "bag", ROAD, scale=16.0)
    assert found.lateral is not None and found.lateral < 0.01 and found.outcome(2.0) is None
    assert found.share == pytest.approx(0.5, abs=0.05) and found.when == "2026-03-01T00:00:00+00:00"


def test_a_tub_tells_when_and_leaves_the_verdict_to_a_person(tmp_path: Path) -> None:
    found = read_recording(write_tub(tmp_path, [{"_timestamp_ms": 1_772_323_200_000}]), ROAD, scale=16.0)
    assert (found.lateral, found.share, found.outcome(2.0)) == (None, None, None)
    assert found.when == "2026-03-01T00:00:00+00:00"
