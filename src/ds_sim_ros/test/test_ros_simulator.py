# SPDX-License-Identifier: Apache-2.0
"""A simulator of ROS: its description, what is read from messages, what is written as a road, and its throttle."""

from __future__ import annotations

import json
import math
from pathlib import Path
from types import SimpleNamespace as Message
from typing import Any

import numpy as np
import pytest
import yaml

from ds_road import Road, RoadError
from ds_sim.conditions.actuation import COMMAND_CONDITIONS
from ds_sim.registry import UntrustedSimulatorError, make_simulator, received_simulator
from ds_sim.simulator import MAX_SPEED, Command, SimulatorError
from ds_sim_ros.roads import check_is_track, read_track, write_road
from ds_sim_ros.settings import CommandSettings, RosSettings, RosSettingsError, read_settings
from ds_sim_ros.simulator import NOT_REPEATABLE, OdometryReader, RosSimulator, image_of

GOOD: dict[str, Any] = {
    "name": "mine",
    "vehicle": {"length": 4.0, "width": 1.8, "wheelbase": 2.6, "max_steering_angle": 0.5},
    "image": "/car/camera",
    "odometry": "/car/odom",
    "command": {"topic": "/car/cmd", "type": "twist"},
    "road": {"service": "/load_road"},
    "time": {"step": "/step", "seconds": 0.01},
}


def written(folder: Path, **changes: Any) -> Path:
    path = folder / "sim.yaml"
    path.write_text(yaml.safe_dump({key: value for key, value in (GOOD | changes).items() if value is not None}))
    return path


def test_a_description_makes_a_simulator_without_ros_or_the_simulator(tmp_path: Path) -> None:
    simulator = make_simulator(f"ros@{written(tmp_path, crop_top=50, autopilot={'proportional': 0.3})}")
    spec = simulator.spec
    assert (spec.name, spec.wheelbase, spec.crop_top, spec.autopilot.proportional) == ("mine", 2.6, 50, 0.3)
    assert set(spec.conditions) == COMMAND_CONDITIONS
    assert spec.extra["time"] == "lock-step of 5 steps" and spec.extra["camera"] == "geometry unknown"
    simulator.close()


def test_real_time_says_that_it_is_not_deterministic(tmp_path: Path) -> None:
    assert make_simulator(f"ros@{written(tmp_path, time='realtime')}").spec.extra["time"] == NOT_REPEATABLE


def reloaded(file: str) -> dict[str, Any]:
    return {"road": {"file": file, "reload": "/r"}}


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"image": None}, "image: Field required"),
        ({"image": "a b"}, "image: 'a b' is no name of a topic or service, expected one such as /camera/image"),
        ({"speed": 3}, r"speed: there is no such key \(keys: name, vehicle, image"),
        ({"vehicle": GOOD["vehicle"] | {"wheelbase": -1.0}}, "vehicle.wheelbase: -1.0, expected above 0"),
        ({"vehicle": GOOD["vehicle"] | {"width": float("nan")}}, "vehicle.width: "),
        ({"command": {"topic": "/cmd", "type": "joy"}}, "command.type: joy, expected one of twist, twist_stamped"),
        ({"road": {}}, "road: expected exactly one of service, file with reload, and centre_line"),
        ({"road": {"file": "road.json"}}, "road: file and reload belong together: give both, or neither"),
        (reloaded("road.exe"), "road.file: 'road.exe': expected a file that ends in .json or"),
        (reloaded("/etc/road.json"), "road.file: '/etc/road.json' lies outside of the description's folder"),
        (reloaded("a/../../road.csv"), "road.file: 'a/../../road.csv' lies outside"),
        ({"time": "sometimes"}, "time: expected realtime, or the keys step and seconds"),
        ({"time": {"step": "/step", "seconds": 0.03}}, "time: seconds is 0.03: no whole number of steps makes a frame"),
        ({"time": {"step": "/s", "second": 0.01}}, "time.seconds: Field required; time.second: there is no such key"),
        ({"crop_top": 159}, "crop of 159 rows at the top"),
        ({"timeout": 0.0}, "timeout: 0.0, expected at least 0.1"),
    ],
)
def test_a_mistake_is_one_line_that_names_the_file_and_the_key(
    tmp_path: Path, changes: dict[str, Any], line: str
) -> None:
    with pytest.raises(RosSettingsError, match=rf"^{tmp_path}/sim.yaml: .*{line}") as caught:
        read_settings(written(tmp_path, **changes))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "line"),
    [("a: [", "not YAML: line"), ("a: 1\na: 2\n", "the key a comes twice"), ("- 1\n", "expected keys with values")],
)
def test_a_file_that_is_no_mapping_is_one_line(tmp_path: Path, text: str, line: str) -> None:
    path = tmp_path / "sim.yaml"
    path.write_text(text)
    with pytest.raises(RosSettingsError, match=line) as caught:
        read_settings(path)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(RosSettingsError, match=r"cannot be read \(No such file or directory\): check the path"):
        make_simulator(f"ros@{tmp_path / 'absent.yaml'}")


def test_a_received_file_does_not_decide_who_is_commanded() -> None:
    with pytest.raises(UntrustedSimulatorError, match=r"'ros@sim.yaml' sends commands .* --trust 'ros@sim.yaml'"):
        received_simulator("ros@sim.yaml")
    assert received_simulator("ros@sim.yaml", confirmed=["ros@sim.yaml"]) == "ros@sim.yaml"


TRACK = Road.from_road_points([(125.0, 20.0 + 5.0 * i) for i in range(21)])


def odometry(x: float, y: float, yaw: float, *, speed: float = 0.0, turn: float = 0.0, roll: float = 0.0) -> Any:
    cos, sin, c, s = math.cos(yaw / 2), math.sin(yaw / 2), math.cos(roll / 2), math.sin(roll / 2)
    pose = Message(position=Message(x=x, y=y, z=0.3), orientation=Message(w=cos * c, x=cos * s, y=sin * s, z=sin * c))
    twist = Message(linear=Message(x=speed, y=0.0, z=0.0), angular=Message(x=0.0, y=0.0, z=turn))
    return Message(pose=Message(pose=pose), twist=Message(twist=twist))


def reader(**changes: Any) -> OdometryReader:
    return OdometryReader(RosSettings.model_validate(GOOD | changes))


def test_a_pose_is_brought_to_the_road_frame_and_to_the_vehicles_centre() -> None:
    made = reader(origin={"x": 10.0, "y": 0.0, "yaw": math.pi / 2}, vehicle=GOOD["vehicle"] | {"centre_ahead": 1.3})
    made.begin(odometry(0.0, 0.0, 0.0), 0.0)
    state = made.state(odometry(10.0, 5.0, math.pi / 2, speed=4.0, turn=0.5, roll=0.1), 0.5)
    assert (state.x, state.y, state.yaw) == pytest.approx((6.3, 0.0, 0.0))
    assert (state.speed, state.lateral_speed, state.roll, state.heave) == pytest.approx((4.0, 0.65, 0.1, 0.0))
    assert state.steering_angle == -0.25


def test_yaw_goes_on_beyond_a_full_circle() -> None:
    made = reader()
    made.begin(odometry(0.0, 0.0, 0.0), 0.0)
    yaws = [made.state(odometry(0.0, 0.0, 0.5 * k), 0.0).yaw for k in range(20)]
    assert yaws == pytest.approx([0.5 * k for k in range(20)])


def test_nonsense_is_one_line() -> None:
    made, broken = reader(), odometry(0.0, 0.0, 0.0)
    broken.pose.pose.orientation.w = 0.0
    with pytest.raises(SimulatorError, match="^/car/odom: the orientation has the norm 0, expected a unit quaternion$"):
        made.state(broken, 0.0)
    with pytest.raises(SimulatorError, match="^/car/odom: position.y is nan, expected a finite number"):
        made.state(odometry(0.0, math.nan, 0.0), 0.0)
    small = Message(data=b"123", encoding="rgb8", height=2, width=2, step=6)
    wrong = "image of 2 x 2 px, 6 bytes a row and 3 bytes: does not fit"
    with pytest.raises(SimulatorError, match=f"^/car/camera: {wrong}"):
        image_of(small, "/car/camera")


def test_a_bgr_image_of_any_size_becomes_rgb_of_160_rows() -> None:
    pixels = np.full((100, 100, 3), (1, 2, 3), np.uint8)
    image = image_of(Message(data=pixels.tobytes(), encoding="bgr8", height=100, width=100, step=300), "/camera")
    assert image.shape == (160, 320, 3) and image[80, 160].tolist() == [3, 2, 1] and not image.flags.writeable


def test_a_road_is_written_for_a_simulator_that_reloads_it(tmp_path: Path) -> None:
    write_road(TRACK, tmp_path / "road.json")
    written = json.loads((tmp_path / "road.json").read_text())
    assert written["start"] == pytest.approx({"x": 127.0, "y": 20.0, "yaw": math.pi / 2})
    assert written["lane"] == "right" and written["centre_line"][1] == [125.0, 25.0]
    write_road(TRACK, tmp_path / "road.csv")
    assert read_track(tmp_path / "road.csv", None, None) == (TRACK, (0.0, 0.0))


def test_only_the_road_of_a_fixed_track_is_accepted(tmp_path: Path) -> None:
    write_road(TRACK, tmp_path / "track.csv")
    settings = RosSettings.model_validate(GOOD | {"road": {"centre_line": "track.csv"}})
    simulator = RosSimulator(settings, tmp_path)
    for lane in ("right", "left"):
        check_is_track(TRACK.in_lane(lane), TRACK, "mine")  # type: ignore[arg-type]
    fixed = "is not the track of mine, which is fixed: drive the road that ds road import makes"
    shifted = Road.from_road_points(TRACK.points + [0.5, 0.0])
    for road in (shifted, Road.from_road_points(TRACK.points[:-4])):
        with pytest.raises(RoadError, match=fixed):
            simulator.load(road, seed=1)
    with pytest.raises(SimulatorError, match="mine: no road is loaded"):
        simulator.step(Command(0.0, 0.0))
    (tmp_path / "track.csv").write_text("x,y\n1,2\n")
    with pytest.raises(RosSettingsError, match="track.csv: not one track .*expected at least two lines x,y"):
        RosSimulator(settings, tmp_path)


def test_a_track_outside_of_the_box_is_driven_in_it_from_where_the_simulator_has_it(tmp_path: Path) -> None:
    """A track of 3 m about the origin of a frame that is turned by 90 degrees and moved."""
    rows = "".join(f"{x},0,1,2\n" for x in range(-30, 31, 3))
    (tmp_path / "track.csv").write_text("x_m,y_m,w_tr_right_m,w_tr_left_m\n" + rows)
    origin = {"x": 5.0, "y": 7.0, "yaw": math.pi / 2}
    road = {"centre_line": "track.csv", "lane": "single"}
    simulator = RosSimulator(RosSettings.model_validate(GOOD | {"road": road, "origin": origin}), tmp_path)
    own = simulator.own_road
    assert own is not None and own.validity.valid and (own.lane, own.lane_width) == ("single", 3.0)
    reader = simulator._world._reader
    reader.begin(odometry(4.5, -23.0, math.pi / 2), 0.0)  # the first point of the track's middle: (-30, 0.5)
    state = reader.state(odometry(4.5, -23.0, math.pi / 2), 0.0)
    assert (state.x, state.y) == pytest.approx(tuple(own.lane_centre[0]), abs=1e-6)


@pytest.mark.parametrize("drag", [0.1, 0.3, 10.0])
def test_the_throttle_law_settles_whatever_the_drag(drag: float) -> None:
    command, speeds = CommandSettings(topic="/drive", type="twist", acceleration=3.0, drag=drag), [0.0]
    for _ in range(1000):
        speeds.append(command.speed_after(speeds[-1], max(0.0, 1.0 - (speeds[-1] / MAX_SPEED) ** 2)))
    assert np.ptp(speeds[-100:]) < 0.01 and 0.0 < speeds[-1] < MAX_SPEED
    for _ in range(2000):
        speeds.append(command.speed_after(speeds[-1], 0.0))
    assert speeds[-1] < 0.01
