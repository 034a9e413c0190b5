# SPDX-License-Identifier: Apache-2.0
"""The file that describes a simulator: what it may hold, and one line for each mistake."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from ros_description import GOOD

from ds_sim.registry import UnknownSimulatorError, UntrustedSimulatorError, make_simulator, received_simulator
from ds_sim.road_simulator import COMMAND_CONDITIONS
from ds_sim_ros.settings import RosSettingsError, read_settings
from ds_sim_ros.simulator import NOT_REPEATABLE


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


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"image": None}, "image: Field required"),
        (
            {"image": "no topic"},
            "image: 'no topic' is no name of a topic or service, expected one such as /camera/image",
        ),
        ({"speed": 3}, r"speed: there is no such key \(keys: name, vehicle, image"),
        ({"vehicle": GOOD["vehicle"] | {"wheelbase": -1.0}}, "vehicle.wheelbase: -1.0, expected above 0"),
        ({"vehicle": GOOD["vehicle"] | {"width": float("nan")}}, "vehicle.width: "),
        ({"command": {"topic": "/cmd", "type": "joy"}}, "command.type: joy, expected one of twist, twist_stamped"),
        ({"road": {}}, "road: expected exactly one of service, file with reload, and centre_line"),
        ({"road": {"file": "road.json"}}, "road: file and reload belong together: give both, or neither"),
        (
            {"road": {"file": "road.exe", "reload": "/r"}},
            "road.file: 'road.exe': expected a file that ends in .json or",
        ),
        (
            {"road": {"file": "/etc/road.json", "reload": "/r"}},
            "road.file: '/etc/road.json' lies outside of the description's folder",
        ),
        ({"road": {"file": "a/../../road.csv", "reload": "/r"}}, "road.file: 'a/../../road.csv' lies outside"),
        ({"time": "sometimes"}, "time: expected realtime, or the keys step and seconds"),
        ({"time": {"step": "/step", "seconds": 0.03}}, "time: seconds is 0.03: no whole number of steps makes a frame"),
        (
            {"time": {"step": "/step", "second": 0.01}},
            "time.seconds: Field required; time.second: there is no such key",
        ),
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


def test_a_missing_file_and_no_file_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(RosSettingsError, match=r"cannot be read \(No such file or directory\): check the path"):
        make_simulator(f"ros@{tmp_path / 'absent.yaml'}")
    with pytest.raises(UnknownSimulatorError, match="simulator 'ros' needs a file or folder: ros@PATH"):
        make_simulator("ros")


def test_a_received_file_does_not_decide_who_is_commanded() -> None:
    with pytest.raises(UntrustedSimulatorError, match=r"'ros@sim.yaml' sends commands .* --trust 'ros@sim.yaml'"):
        received_simulator("ros@sim.yaml")
    assert received_simulator("ros@sim.yaml", confirmed=["ros@sim.yaml"]) == "ros@sim.yaml"
