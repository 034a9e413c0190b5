# SPDX-License-Identifier: Apache-2.0
"""A recording as a simulator: what it shows elsewhere, what it does not know, and one line for what is wrong with it.

The recording is made here: a floor whose colour is a closed form of the place, seen by a pinhole on a bent road.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from tubs import write_tub

from ds_recording import RecordingError
from ds_recording.floor_camera import FloorCamera, write_camera
from ds_recording.located import COLUMNS
from ds_recording.sibling.recorded_drive import read_drive, sections
from ds_recording.sibling.simulator import PhotoScene, RecordingSimulator, network_grid
from ds_road import Road, RoadError
from ds_sim.registry import UnknownSimulatorError, make_simulator
from ds_sim.scenario import Scenario
from ds_sim.session import Session
from ds_sim.simulator import Command, Outcome, Reason, VehicleState

WIDTH, HEIGHT, FOCAL, HIGH, PITCH, FORWARD = 160, 120, 90.0, 0.12, 0.2, 0.04
LANE = 0.25
"""Width of a lane, m on the floor; 16 of these metres are one on the floor of the model."""
STEP = 0.04
"""Distance between two photographs, m."""


def colour(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Smooth pattern of the floor, grey levels."""
    return np.stack([127 + 100 * np.sin(6 * x), 127 + 100 * np.cos(7 * y), 127 + 100 * np.sin(4 * (x + y))], axis=-1)


def seen(x: float, y: float, yaw: float, columns: NDArray[np.float64], rows: NDArray[np.float64]) -> NDArray[np.uint8]:
    """What a pinhole sees of the floor from a pose, m on the floor; blue above the horizon."""
    right = np.broadcast_to((columns - (WIDTH - 1) / 2) / FOCAL, (len(rows), len(columns)))
    down = np.broadcast_to(((rows - (HEIGHT - 1) / 2) / FOCAL)[:, None], right.shape)
    sinks = math.sin(PITCH) + down * math.cos(PITCH)
    far = HIGH / np.maximum(sinks, 1e-3)
    ahead, left = far * (math.cos(PITCH) - down * math.sin(PITCH)) + FORWARD, -far * right
    place = x + math.cos(yaw) * ahead - math.sin(yaw) * left, y + math.sin(yaw) * ahead + math.cos(yaw) * left
    image = np.where((sinks > 0.05)[..., None], colour(*place), (40, 60, 200))
    return np.asarray(np.rint(image), np.uint8)


def way() -> list[tuple[float, float, float]]:
    """Poses of the car: straight north, then a bend to the right of 1.5 m radius, then straight."""
    poses, (x, y, yaw) = [], (5.0, 5.0, math.pi / 2)
    for k in range(160):
        poses.append((x, y, yaw))
        turn = -STEP / 1.5 if 60 <= k < 90 else 0.0
        x, y, yaw = x + STEP * math.cos(yaw + turn / 2), y + STEP * math.sin(yaw + turn / 2), yaw + turn
    return poses


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A located recording on the centre line of the right lane."""
    made = tmp_path_factory.mktemp("recording")
    (made / "tub/images").mkdir(parents=True)
    columns, rows = np.arange(float(WIDTH)), np.arange(float(HEIGHT))
    records: list[dict[str, object]] = []
    located, track = [], []
    for k, (x, y, yaw) in enumerate(way()):
        cv2.imwrite(str(made / f"tub/images/{k}.png"), seen(x, y, yaw, columns, rows)[..., ::-1])
        about = {"cam/image_array": f"{k}.png", "user/mode": "user"}
        records.append(about | {"user/angle": 0.0, "user/throttle": 0.2})
        located.append((k, 0.05 * k, x, y, yaw, STEP * k, LANE / 2, 0, 0.8, 0, 0, 0, 0, 0.2))
        track.append((x - LANE / 2 * math.sin(yaw), y + LANE / 2 * math.cos(yaw), LANE, LANE))
    write_tub(made / "tub", records)
    for name, head, lines in (("located", ",".join(COLUMNS), located), ("track", "# x_m,y_m", track)):
        (made / f"{name}.csv").write_text("\n".join([head, *(",".join(map(str, line)) for line in lines)]) + "\n")
    camera = FloorCamera(
        width_px=WIDTH,
        height_px=HEIGHT,
        focal_px=(FOCAL, FOCAL),
        centre_x_px=(WIDTH - 1) / 2,
        centre_y_px=(HEIGHT - 1) / 2,
        height_m=HIGH,
        pitch_rad=PITCH,
        forward_m=FORWARD,
    )
    write_camera(made / "camera.yaml", camera)
    (made / "recording.json").write_text(json.dumps({"source": "tub", "lane_width_m": LANE}))
    return made


def pose_near(folder: Path, index: int, left: float, turn: float) -> tuple[VehicleState, tuple[float, float, float]]:
    """A pose beside a photograph, as road metres for the scene and as metres on the floor."""
    x, y, yaw = way()[index]
    x, y, yaw = x - left * math.sin(yaw), y + left * math.cos(yaw), yaw + turn
    shift = read_drive(folder).poses[index, :2] - 16.0 * np.array(way()[index][:2])
    state = VehicleState(x=16 * x + shift[0], y=16 * y + shift[1], yaw=yaw, speed=0.0, yaw_rate=0.0, steering_angle=0.0)
    return state, (x, y, yaw)


@pytest.mark.parametrize(
    ("left", "turn", "error"), [(0.0, 0.0, 0.6), (0.06, 0.0, 2.0), (0.0, 0.17, 2.0), (-0.08, -0.12, 4.0)]
)
def test_a_photograph_is_moved_as_the_floor_says(folder: Path, left: float, turn: float, error: float) -> None:
    scene = PhotoScene(read_drive(folder))
    state, place = pose_near(folder, 75, left, turn)
    found = scene.still(state)
    columns, rows = network_grid(WIDTH, HEIGHT)
    true = seen(*place, columns, rows)
    floor = rows > (HEIGHT - 1) / 2 - FOCAL * math.tan(PITCH) + 10.0  # below what aliases near the horizon
    off = np.abs(found[floor].astype(float) - true[floor])
    assert off.mean() < error and np.quantile(off, 0.95) < 8 * error
    unmoved = np.abs(scene.still(pose_near(folder, 75, 0.0, 0.0)[0])[floor].astype(float) - true[floor])
    assert left == turn == 0.0 or off.mean() < 0.2 * unmoved.mean()


def test_what_a_photograph_does_not_show_comes_from_those_behind(folder: Path) -> None:
    drive = read_drive(folder)
    scene = PhotoScene(drive)
    scene.still(pose_near(folder, 110, 0.1, 0.3)[0])
    alone = PhotoScene(drive)
    alone._chosen = lambda *pose: (110, [])  # type: ignore[method-assign]
    alone.still(pose_near(folder, 110, 0.1, 0.3)[0])
    assert scene.unseen < 0.6 * alone.unseen


@pytest.fixture
def road(folder: Path) -> Road:
    (road,) = sections(read_drive(folder), 80.0, 1000.0)
    return road


def test_it_drives_to_the_end_and_repeats_its_bytes(folder: Path, road: Road) -> None:
    simulator = RecordingSimulator.from_file(folder)
    digests = []
    for _ in range(2):
        session = Session(simulator)
        frame = session.start(Scenario(road, seed=1))
        images = 0
        while session.driving:
            assert frame is not None
            images = hash((images, frame.image.tobytes()))
            frame = session.advance(Command(float(np.clip(0.4 * -frame.lane.preview_lateral_position, -1, 1)), 0.3))
        assert session.run is not None and session.run.outcome is Outcome.COMPLETED, session.run
        digests.append(images)
    assert digests[0] == digests[1]


def test_beyond_its_photographs_it_does_not_know(folder: Path, road: Road) -> None:
    session = Session(RecordingSimulator.from_file(folder))
    session.start(Scenario(road, seed=1))
    while session.driving:
        session.advance(Command(1.0, 0.6))
    assert session.run is not None
    ended = session.run.outcome, session.run.reason
    assert ended in ((Outcome.SIM_ERROR, Reason.OUT_OF_SIGHT), (Outcome.OUT_OF_BOUNDS, Reason.NONE))
    scene = PhotoScene(read_drive(folder))
    with pytest.raises(Exception, match="does not show what it would see"):
        scene.still(pose_near(folder, 75, 0.3, 0.0)[0])


def test_only_its_own_track_is_driven(folder: Path, road: Road) -> None:
    simulator = RecordingSimulator.from_file(folder)
    for other in (road.reversed(), road.mirrored(), road.in_lane("left")):
        with pytest.raises(RoadError, match="is no section of the recorded track: make roads with"):
            simulator.load(other, seed=1)


NO_NUMBERS = ",".join(["nan"] * 14)


@pytest.mark.parametrize(
    ("name", "text", "line"),
    [
        ("recording.json", "{}", "lane_width_m in recording.json is None, expected metres"),
        ("recording.json", '{"source": "tub", "lane_width_m": 4.0}', "a lane of 4 m, expected 0.0625 to 1.25"),
        ("recording.json", '{"source": "elsewhere", "lane_width_m": 0.25}', "elsewhere: .*: put the recording there"),
        ("located.csv", "frame,x\n1,2\n", "located.csv has the columns frame,x, expected frame,time_s"),
        ("located.csv", "\n".join([",".join(COLUMNS), NO_NUMBERS, NO_NUMBERS]), "needs a row of 14 numbers"),
        ("camera.yaml", "image_width: -1\n", "camera.yaml: "),
        ("track.csv", "0,0\n", "track.csv: not a track: expected at least two lines"),
        ("simulator.yaml", "car: 3\n", "simulator.yaml: car: "),
        ("simulator.yaml", "crop_top: 500\n", "simulator.yaml: crop_top: 500, expected below 160"),
    ],
)
def test_a_broken_folder_is_one_line(folder: Path, tmp_path: Path, name: str, text: str, line: str) -> None:
    for file in folder.iterdir():
        (tmp_path / file.name).symlink_to(file)
    (tmp_path / name).unlink(missing_ok=True)
    (tmp_path / name).write_text(text)
    with pytest.raises(RecordingError, match=line) as caught:
        RecordingSimulator.from_file(tmp_path)
    assert "\n" not in str(caught.value)


def test_without_a_folder_it_says_what_it_needs() -> None:
    with pytest.raises(UnknownSimulatorError, match="needs a file or folder: recording@PATH"):
        make_simulator("recording")
