# SPDX-License-Identifier: Apache-2.0
"""Recorded drives become a data set for training and RQ1, and outcomes of real drives; simulated ones stand in."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from floor_cameras import floor_camera
from foreign_bags import foreign_bag
from tests import drives
from tubs import write_tub

from ds_bags.layout import BagError
from ds_bags.run_writer import write_bag
from ds_base.left_out import LeftOut
from ds_base.progress import SILENT
from ds_driver.data.dataset import DatasetError, crops_of, decode, read_samples
from ds_driver.data.recordings import Imported, Reading, import_recordings, open_recording
from ds_driver.networks.images import Crop, fit_to_network
from ds_driver.training import TrainingPlan, split
from ds_recording import RecordingError
from ds_recording.located import COLUMNS, Located, write_located
from ds_recording.real_drive import is_recording, read_recording
from ds_recording.track import Track
from ds_road import Road
from ds_sim.registry import DONKEY, UntrustedSimulatorError
from ds_sim.session import RunRecord

COUNT = 250


@pytest.fixture
def tub(tmp_path: Path) -> Path:
    """A drive of 250 images of 160 x 120, each brighter than the one before; the last one without steering."""
    (tmp_path / "tub/images").mkdir(parents=True)
    rows = []
    for index in range(COUNT):
        cv2.imwrite(str(tmp_path / f"tub/images/{index}.png"), picture(index))
        steered = {"user/angle": index / COUNT, "user/throttle": 0.5} if index < COUNT - 1 else {}
        rows.append({"cam/image_array": f"{index}.png", **steered})
    return write_tub(tmp_path / "tub", rows, deleted=[2])


def picture(index: int) -> np.ndarray:
    return np.full((120, 160, 3), index, np.uint8)


def imported(tub: Path, out: Path, name: str = "car") -> Imported:
    return import_recordings([open_recording(tub, Reading())], out, name, SILENT)


def test_a_tub_becomes_part_of_a_data_set(tub: Path, tmp_path: Path) -> None:
    assert imported(tub, tmp_path / "data") == Imported(name="car", images=COUNT - 2, unlabelled=1, files=3)
    samples = read_samples(tmp_path / "data")
    kept = [i for i in range(COUNT - 1) if i != 2]
    assert [s.steering for s in samples] == pytest.approx([i / COUNT for i in kept])
    for sample, index in list(zip(samples, kept, strict=True))[::50]:
        assert np.abs(decode(sample.jpeg).astype(int) - fit_to_network(picture(index))).max() <= 2
    training, validation = split(samples, TrainingPlan())
    assert {s.road_id for s in training} | {s.road_id for s in validation} == {f"tub.000{k}" for k in range(3)}
    assert crops_of(tmp_path / "data", ["car", "donkey"])["car"] == Crop()
    assert crops_of(tmp_path / "data", ["donkey"])["donkey"] != Crop()


def test_a_failed_import_is_reported_in_one_line(tub: Path, tmp_path: Path) -> None:
    for name in ("donkey", "../car", "my car", ".."):
        with pytest.raises(DatasetError, match=r"choose another --name$"):
            imported(tub, tmp_path / "data", name)
    imported(tub, tmp_path / "data")
    with pytest.raises(DatasetError, match="is there already"):
        imported(tub, tmp_path / "data")
    with pytest.raises(UntrustedSimulatorError, match="'car'"):
        crops_of(tmp_path / "elsewhere", ["car"])
    (tub / "images" / "7.png").write_bytes(b"\x89PNG cut")
    with pytest.raises(DatasetError, match=r"7\.png: an image is damaged, or neither JPEG nor PNG$"):
        imported(tub, tmp_path / "other")
    assert not list((tmp_path / "other").glob("*/*.parquet"))  # no incomplete file
    rows = [json.loads(line) for line in (tub / "catalog_0.catalog").read_text().splitlines()]
    for row in rows:
        row.pop("user/angle", None)
    (tub / "catalog_0.catalog").write_text("".join(json.dumps(row) + "\n" for row in rows if row["_index"] != 7))
    with pytest.raises(DatasetError, match="no image has a steering"):
        imported(tub, tmp_path / "third")


def test_images_that_cannot_be_read_are_counted_and_named(tub: Path, tmp_path: Path) -> None:
    """The card was full: the images from the 200th on are empty."""
    for index in range(200, COUNT):
        (tub / "images" / f"{index}.png").write_bytes(b"")
    left_out = LeftOut("images")
    found = import_recordings([open_recording(tub, Reading())], tmp_path / "data", "car", SILENT, left_out)
    assert (found.images, len(left_out.items), left_out.total) == (199, 50, 249)
    assert left_out.line().startswith("50 of 249 images left out: tub (") and left_out.line().endswith("; and 47 more")
    for index in range(200):
        (tub / "images" / f"{index}.png").write_bytes(b"")
    with pytest.raises(DatasetError, match="249 of 249 images left out: tub"):
        import_recordings([open_recording(tub, Reading())], tmp_path / "none", "car", SILENT, LeftOut("images"))


WALL = 1_700_000_000 * 10**9


def recorded_bag(folder: Path, *, images: int | None, steering: int | None, stamped: bool, late: float = 0.0) -> Path:
    """40 images at 20 Hz, and a steering 10 ms after each of them, which without a stamp is a Twist.

    Their first headers have a time, ns, or None; the steering is logged later by `late`, s.
    """
    with foreign_bag(folder, Steer="std_msgs/Header header\nfloat32 angle") as bag:
        for index in range(40):
            passed = index * 50_000_000
            pixels = np.full((30, 40, 3), 5 * index, np.uint8)
            bag.write("/camera", WALL + passed, bag.image(0 if images is None else images + passed, pixels, "rgb8"))
            passed, angle = passed + 10_000_000, index / 40
            if stamped:
                header = bag.header(0 if steering is None else steering + passed)
                command = bag.make("car/Steer", header=header, angle=angle)
            else:
                command = bag.make("geometry_msgs/Twist", linear=bag.vector(x=1.0), angular=bag.vector(z=angle))
            bag.write("/steer", WALL + passed + int(late * 1e9), command)
    return folder


SIMULATED = 5 * 10**9


@pytest.mark.parametrize(
    ("images", "steering", "stamped", "late", "by_headers"),
    [
        (WALL, WALL, True, 3600.0, True),  # logged by another computer, whose clock is wrong
        (WALL, None, True, 0.0, False),  # a student's node sets no stamp
        (None, WALL, True, 0.0, False),
        (SIMULATED, WALL, True, 0.0, False),  # images in simulated time
        (SIMULATED, None, False, 0.0, False),  # and a Twist, which has no header
        (SIMULATED, SIMULATED, True, 0.0, True),
    ],
)
def test_images_and_steering_meet_on_the_clock_that_both_have(
    tmp_path: Path, images: int | None, steering: int | None, stamped: bool, late: float, by_headers: bool
) -> None:
    bag = recorded_bag(tmp_path / "bag", images=images, steering=steering, stamped=stamped, late=late)
    recording = open_recording(bag, Reading(steering=f"/steer:{'angle' if stamped else 'angular.z'}"))
    assert recording.headers is by_headers
    frames = list(recording.frames())
    assert [frame.steering for frame in frames] == pytest.approx([index / 40 for index in range(40)])
    assert [frame.seconds for frame in frames] == pytest.approx([index / 20 for index in range(40)])


def test_without_a_common_clock_both_ranges_are_named(tmp_path: Path) -> None:
    bag = recorded_bag(tmp_path / "bag", images=SIMULATED, steering=None, stamped=False, late=60.0)
    with pytest.raises(BagError, match=r"have no clock in common: /camera: headers 5.0 to 7.0 s, logged"):
        list(open_recording(bag, Reading(steering="/steer:angular.z")).frames())


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
    track = Track(np.column_stack((along, np.zeros(101))))
    about = {"source": "tub", "lane_width_m": 0.25}
    write_located(
        tmp_path, Located(table=table, track=track, lane_width=0.25, camera=floor_camera(90.0, 0.1, 0.2), about=about)
    )
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
