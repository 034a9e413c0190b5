# SPDX-License-Identifier: Apache-2.0
"""Starts fits from files of cars, with values worked out by hand, and from what strangers may send."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from ds_twin_donkey.car_files import ParameterFileError, read_start
from ds_twin_donkey.parameters import DonkeyParameters

MYCONFIG = """
import os, math
CAR_PATH = os.path.dirname(os.path.realpath(__file__))
open("{here}/ran", "w")
IMAGE_W = 160
WHEEL_BASE = 0.22
AXLE_LENGTH = 0.175
MAX_STEERING_ANGLE = math.radians(25)
PWM_STEERING_THROTTLE = {{
    "STEERING_LEFT_PWM": 450,
    "STEERING_RIGHT_PWM": 300,
    "THROTTLE_FORWARD_PWM": 480,
    "THROTTLE_STOPPED_PWM": 370,
}}
"""
VESC = """
/**:
  ros__parameters:
    steering_angle_to_servo_gain: -1.2135
    steering_angle_to_servo_offset: 0.5304
    servo_min: 0.15
    servo_max: 0.85
vesc_to_odom_node:
  ros__parameters: {odom_frame: odom, wheelbase: .25}
"""
GYM = """{mu: 1.0489, C_Sf: 4.718, C_Sr: 5.4562, lf: 0.15875, lr: 0.17145, h: 0.074, m: 3.74, I: 0.04712,
          s_max: 0.4189, sv_max: 3.2}"""
WHEEL = '<link name="{}_wheel"><visual><geometry><cylinder radius="0.05"/></geometry></visual></link>'
URDF = """<?xml version="1.0"?>
<robot name="racecar">
  <link name="base_link"><inertial><mass value="3.0"/></inertial></link>
  <link name="front_left_hinge"/>
  {wheels}
  <joint name="base_to_front_left_hinge" type="revolute">
    <parent link="base_link"/><child link="front_left_hinge"/><origin xyz="0.32 0.1 0"/>
    <limit lower="-0.42" upper="0.4"/>
  </joint>
  <joint name="a" type="continuous"><parent link="front_left_hinge"/><child link="front_left_wheel"/></joint>
  <joint name="b" type="continuous">
    <parent link="base_link"/><child link="front_right_wheel"/><origin xyz="0.32 -0.1 0"/>
  </joint>
  <joint name="c" type="continuous">
    <parent link="base_link"/><child link="back_left_wheel"/><origin xyz="0 0.1 0"/>
  </joint>
  <link name="mast"/><link name="camera_link"/>
  <joint name="d" type="fixed">
    <parent link="base_link"/><child link="mast"/><origin xyz="0.26 0 0.1" rpy="0 0.2 0"/>
  </joint>
  <joint name="e" type="fixed"><parent link="mast"/><child link="camera_link"/><origin rpy="0 0.1 0"/></joint>
</robot>
""".format(wheels="".join(map(WHEEL.format, ("front_left", "front_right", "back_left"))))
CIRCLE = '<joint><parent link="wheel"/><child link="wheel"/></joint>'
NOMINAL = DonkeyParameters()


def written(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_donkey_cars_configuration_is_read_and_never_executed(tmp_path: Path) -> None:
    start = read_start(written(tmp_path, "myconfig.py", MYCONFIG.format(here=tmp_path)))
    found = start.parameters
    assert (found.wheelbase, found.track, found.mass) == (0.22, 0.175, NOMINAL.mass)
    assert found.max_steering_angle == pytest.approx(math.radians(25.0))
    assert (found.steering_pulse_steps, found.throttle_pulse_steps) == (75, 110)
    assert "wheelbase 0.22" in start.taken
    assert not (tmp_path / "ran").exists()


def test_a_configuration_may_calculate(tmp_path: Path) -> None:
    lines = "MAX_STEERING_ANGLE = 3.14159 / 8\nWHEEL_BASE = 2 * (0.05 + 0.06) - 0.01\n"
    found = read_start(written(tmp_path, "myconfig.py", lines)).parameters
    assert (found.max_steering_angle, found.wheelbase) == pytest.approx((3.14159 / 8, 0.21))


def test_roboracers_yaml_is_read_whether_of_the_car_or_of_the_simulator(tmp_path: Path) -> None:
    car = read_start(written(tmp_path, "vesc.yaml", VESC)).parameters
    assert car.wheelbase == 0.25
    assert car.max_steering_angle == pytest.approx(0.35 / 1.2135)
    gym = read_start(written(tmp_path, "gym.yaml", GYM)).parameters
    assert gym.wheelbase == pytest.approx(0.3302)
    assert gym.front_share == pytest.approx(0.17145 / 0.3302)
    assert (gym.mass, gym.yaw_inertia, gym.servo_rate, gym.max_steering_angle) == (3.74, 0.04712, 3.2, 0.4189)
    # The nominal car has these tyres.
    assert (gym.front_stiffness, gym.rear_stiffness) == pytest.approx((4.95, 5.72), rel=1e-3)


def test_a_urdf_gives_wheels_steering_and_the_pose_of_the_camera(tmp_path: Path) -> None:
    start = read_start(written(tmp_path, "car.urdf", URDF))
    found = start.parameters
    assert (found.wheelbase, found.track) == pytest.approx((0.32, 0.2))
    assert (found.mass, found.max_steering_angle) == (3.0, 0.4)
    assert start.taken[-1] == "for camera.yaml: height_m: 0.15, pitch_rad: 0.3, forward_m: 0.1"


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("myconfig.py", "__import__('os').system('true')", "nothing about the car's geometry"),
        ("myconfig.py", "WHEEL_BASE = 'long'", "WHEEL_BASE is 'long', expected a number"),
        ("myconfig.py", "WHEEL_BASE = -1", "wheelbase is -1.0, expected a number"),
        ("myconfig.py", "WHEEL_BASE = 1 / 0", "nothing about the car's geometry"),
        ("myconfig.py", "WHEEL_BASE = " + "1 + " * 800 + "'a'", "nothing about the car's geometry"),
        ("myconfig.py", "WHEEL_BASE = (", "was never closed"),
        ("myconfig.py", "x = " + "-" * 100_000 + "1", "nested too deeply"),
        ("car.yaml", "{lf: .nan, lr: 0.1}", "lf is nan, expected a number"),
        ("car.yaml", "[1, 2]", "nothing about the car's geometry"),
        ("car.urdf", URDF.replace("0.32 0.1 0", "0.32 x 0"), "could not convert string to float"),
        ("car.urdf", URDF.replace('value="3.0"', 'value="nan"'), "mass is nan, expected a number"),
        ("car.urdf", URDF.replace('"0.32 0.1 0"', '"${wheelbase} 0 0"'), "type `xacro FILE > car.urdf`"),
        ("car.urdf", URDF.replace("_wheel", ""), "no front and rear wheels"),
        ("car.urdf", '<!DOCTYPE r [<!ENTITY a "aa">]><robot>&a;</robot>', "document type"),
        ("car.urdf", f'<robot><link name="wheel"/>{CIRCLE}</robot>', "form a circle"),
    ],
)
def test_what_no_car_has_is_refused_in_one_line(tmp_path: Path, name: str, text: str, expected: str) -> None:
    with pytest.raises(ParameterFileError) as caught:
        read_start(written(tmp_path, name, text))
    message = str(caught.value)
    assert expected in message
    assert "\n" not in message and len(message) < 700
