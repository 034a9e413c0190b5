# SPDX-License-Identifier: Apache-2.0
"""Motion of a car from odometry, gyroscopes and poses in closed form, and from images of a hall that is drawn here."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from floor_cameras import floor_camera
from foreign_bags import foreign_bag
from numpy.typing import NDArray
from tubs import write_tub

from ds_driver.data.recordings import Reading, Recording
from ds_driver.networks.images import Crop
from ds_recording import RecordingError
from ds_recording.motion import Hint, HintFinder
from ds_recording.odometry import AHEAD, TURN, Checked, Source, _rate, check, hints_of, read_sources, stretch, summary

Array = NDArray[np.float64]
LANE, SHORT, LATE = 0.25, 0.97, 0.05
"""Lane width, m; ways in images over the true ones; time by which images are later, s."""
RNG = np.random.default_rng(7)
SECONDS: Array = np.cumsum(0.05 + 0.004 * RNG.uniform(-1, 1, 600))
STAMPS: Array = np.arange(-1.0, 33.0, 0.013)


def speed(t: Array) -> Array:
    return 1.0 + 0.3 * np.sin(0.7 * t)


def way(t: Array) -> Array:
    return t - 0.3 / 0.7 * np.cos(0.7 * t)


def rate(t: Array) -> Array:
    return 1.2 * np.sin(1.1 * t)


def yaw(t: Array) -> Array:
    return -1.2 / 1.1 * np.cos(1.1 * t)


TRUE: Array = np.stack((np.diff(way(SECONDS - LATE)), 0 * SECONDS[1:], np.diff(yaw(SECONDS - LATE))), axis=1)
STDS = np.tile([0.008, 0.008, 0.003], (len(TRUE), 1))
SEEN: Array = TRUE * [SHORT / LANE, 1.0, 1.0] + STDS * RNG.normal(size=TRUE.shape)


def encoder(values: Array | None = None, times: Array = STAMPS) -> Source:
    return _rate("enc/speed", "enc/speed", AHEAD, times, speed(times) if values is None else values)


def gyroscope(values: Array, name: str = "imu/gyr_z") -> Source:
    return _rate(name, "imu/gyr", TURN, STAMPS, values)


def checked(*sources: Source) -> list[Checked]:
    return check(sources, SECONDS, SEEN, STDS, LANE)


def test_scale_bias_and_delay_are_found() -> None:
    noise = np.random.default_rng(2).normal(size=(2, len(STAMPS)))
    found = checked(encoder(speed(STAMPS) + 0.02 * noise[0]), gyroscope(rate(STAMPS) - 0.04 + 0.01 * noise[1]))
    ways, turns = sorted(found, key=lambda c: c.source.part)
    assert not ways.reason and not turns.reason
    assert ways.scale == pytest.approx(SHORT, abs=0.005) and turns.bias == pytest.approx(0.04, abs=0.003)
    assert turns.delay == pytest.approx(LATE, abs=0.026)
    np.testing.assert_allclose(turns.steps, TRUE[:, 2], atol=0.006)
    np.testing.assert_allclose(ways.steps, SHORT * TRUE[:, 0], atol=0.004)
    assert 0.0005 < turns.std < 0.003
    # An encoder of 2% and images of 5% agree on 0.86 of the difference.
    assert stretch(found) * SHORT == pytest.approx(1.0 - 0.14 * (1.0 - SHORT), abs=0.006)
    hints = hints_of(found, len(SECONDS), LANE)
    assert np.isinf(hints[0].std).all() and math.isinf(hints[9].std[1])
    assert hints[9].step[0] * LANE == pytest.approx(SHORT * TRUE[8, 0], abs=0.004)
    assert "corrected by +2.3 degrees/s" in summary({"odometry": [c.about for c in found]})


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        (-rate(STAMPS), "negate it"),
        (np.degrees(rate(STAMPS)).clip(-49, 49), "another axis or unit"),
        (np.full_like(STAMPS, 0.31), ""),
        (0.05 * np.random.default_rng(4).normal(size=len(STAMPS)), ""),
    ],
    ids=["reversed", "degrees", "stuck", "noise"],
)
def test_a_gyroscope_that_contradicts_the_images_is_reported_and_left_out(values: Array, reason: str) -> None:
    (found,) = checked(gyroscope(values))
    assert found.reason and reason in found.reason and "\n" not in found.reason
    assert all(np.isinf(hint.std).all() for hint in hints_of([found], len(SECONDS), LANE))
    json.dumps(found.about, allow_nan=False)
    assert "not used" in summary({"odometry": [found.about]})


def test_an_encoder_that_is_stuck_or_stands_is_left_out_and_one_out_of_scale_gives_no_metres() -> None:
    for values in (np.full_like(STAMPS, 1.0), np.zeros_like(STAMPS), -speed(STAMPS)):
        assert checked(encoder(values))[0].reason
    (found,) = checked(encoder(1.3 * speed(STAMPS)))
    assert not found.reason and found.scale == pytest.approx(SHORT / 1.3, rel=0.01) and stretch([found]) == 1.0
    np.testing.assert_allclose(found.steps, SHORT * TRUE[:, 0], atol=0.004)


def test_where_a_wheel_slips_it_says_nothing() -> None:
    slips = (STAMPS > 10.0) & (STAMPS < 11.0)
    (found,) = checked(encoder(np.where(slips, 1.6, 1.0) * speed(STAMPS)))
    slipping = (SECONDS[1:] > 10.2) & (SECONDS[1:] < 10.9)
    assert not found.reason and np.isnan(found.steps[slipping]).all() and np.isfinite(found.steps).mean() > 0.9
    assert found.scale == pytest.approx(SHORT, abs=0.005)


def test_images_that_lose_the_floor_do_not_speak_against_an_encoder_in_metres() -> None:
    """Corners that are lost look as if the car stood still; in other units nobody can say who is right."""
    lost = np.random.default_rng(5).uniform(size=len(SEEN))
    seen = SEEN * np.where(lost < 0.6, lost, 1.0)[:, None]
    (found,) = check([encoder()], SECONDS, seen, STDS, LANE)
    assert not found.reason and found.scale == pytest.approx(SHORT, abs=0.02) and found.std < 0.02
    assert np.nanmax(np.abs(found.steps - SHORT * TRUE[:, 0])) < 0.008
    for other in (3.6 * speed(STAMPS), 0.83 * speed(STAMPS), speed(STAMPS)[::-1] * RNG.uniform(0, 2, len(STAMPS))):
        assert check([encoder(other)], SECONDS, seen, STDS, LANE)[0].reason


def test_what_cannot_be_is_a_gap_and_gaps_stay_unknown() -> None:
    values = speed(STAMPS)
    values[(STAMPS > 5.0) & (STAMPS < 6.0)] = math.nan
    values[(STAMPS > 8.0) & (STAMPS < 9.0)] = 1e300
    (found,) = checked(encoder(values))
    for first in (5.0, 8.0):
        inside = (SECONDS[:-1] - found.delay > first) & (SECONDS[1:] - found.delay < first + 1.0)
        assert inside.sum() > 15 and np.isnan(found.steps[inside]).all()
    assert not found.reason and np.nanmax(np.abs(found.steps - SHORT * TRUE[:, 0])) < 0.004
    (hung,) = checked(encoder(np.where(STAMPS < 15.0, speed(STAMPS), 1.2)))
    assert not hung.reason and np.isnan(hung.steps[SECONDS[1:] > 15.2]).all() and np.isfinite(hung.steps).mean() > 0.45
    # A gap between two images, in none of which an image lies.
    source = encoder(times=np.concatenate((STAMPS[STAMPS < 1.0], STAMPS[STAMPS > 1.5])))
    assert np.isnan(source.steps(np.array([0.5, 0.9, 1.6, 2.0]))).tolist() == [False, True, False]
    for empty in (encoder(np.full_like(STAMPS, math.nan)), encoder(times=STAMPS + 1e6)):
        assert "hardly any values" in checked(empty)[0].reason


def test_of_two_sources_the_better_one_is_used_and_readings_of_one_device_count_once() -> None:
    noisy = replace(encoder(speed(STAMPS) * (1 + 0.3 * RNG.normal(size=len(STAMPS)))), name="other", device="other")
    found = checked(noisy, encoder(), gyroscope(rate(STAMPS)), gyroscope(-rate(STAMPS), "imu/gyr_y"))
    assert [(c.source.name, bool(c.reason)) for c in found if c.source.part == TURN] == [("imu/gyr_z", False)]
    ways = {c.source.name: c.reason for c in found if c.source.part == AHEAD}
    assert ways == {"enc/speed": "", "other": "enc/speed is closer to the images"}


def test_hints_are_fused_by_inverse_variance() -> None:
    inf = math.inf
    both = Hint(np.array([1.0, 0.0, 0.1]), np.array([0.1, inf, 0.01])).fused(
        Hint(np.array([2.0, 0.0, 0.0]), np.array([0.2, inf, inf]))
    )
    np.testing.assert_allclose(both.step, [1.2, 0.0, 0.1])
    np.testing.assert_allclose(both.std, [1.0 / math.sqrt(125.0), inf, 0.01])


def recording_of(path: Path, kind: str) -> Recording:
    return Recording(path=path, group="x", kind=kind, crop=Crop(), reading=Reading())


def test_a_strangers_tub_is_read_in_degrees_and_what_is_no_number_is_left_out(tmp_path: Path) -> None:
    measured = zip(SECONDS, speed(SECONDS - LATE), np.degrees(rate(SECONDS - LATE)), strict=True)
    odd = {"imu/gyr_y": None, "pos/speed": "fast"}
    rows: list[dict[str, Any]] = [
        {"_timestamp_ms": round(1e6 + 1000 * t), "enc/speed": float(v), "imu/gyr_z": float(w), **odd}
        for t, v, w in measured
    ]
    for at, strange in enumerate(("x", None, [1.0], 1e999, {"a": 1}, True, 10**400)):
        rows[100 + at] |= {"enc/speed": strange, "imu/gyr_z": strange}
    tub = recording_of(write_tub(tmp_path, rows), "tub")
    sources = read_sources(tub, 1000.0)
    assert [s.name for s in sources] == ["enc/speed", "imu/gyr_z"]
    ways, turns = sorted(checked(*sources), key=lambda c: c.source.part)
    assert not ways.reason and not turns.reason and ways.scale == pytest.approx(SHORT, abs=0.01)
    assert 0.9 < np.isfinite(turns.steps).mean() < 1.0 and np.isnan(turns.steps[102:104]).all()
    assert np.nanmax(np.abs(turns.steps - TRUE[:, 2])) < 0.01
    assert read_sources(tub, 1000.0, "none") == [] and len(read_sources(tub, 1000.0, "imu/gyr_z")) == 1
    with pytest.raises(RecordingError, match="--odometry '/odom': expected") as error:
        read_sources(tub, 1000.0, "/odom")
    assert "\n" not in str(error.value)


def test_messages_of_odometry_imu_and_motion_capture_are_read(tmp_path: Path) -> None:
    # Motion capture sees the car turned by 2 rad, somewhere else: only its motion counts.
    fine = np.linspace(0.0, 32.0, 32001)
    path = np.cumsum(speed(fine)[:, None] * np.stack((np.cos(yaw(fine) + 2), np.sin(yaw(fine) + 2)), 1), axis=0) / 1000
    nine, many = np.zeros(9), np.zeros(36)
    with foreign_bag(tmp_path / "bag") as bag:
        for t in np.arange(0.0, 31.0, 0.02).tolist():
            index, sent, logged = round(t * 1000), round((100 + t) * 1e9), round((200 + t) * 1e9)
            angle = float(yaw(fine[index]) + 2) / 2
            turned = bag.make("geometry_msgs/Quaternion", x=0.0, y=0.0, z=math.sin(angle), w=math.cos(angle))
            place = bag.vector(path[index, 0] + 9, path[index, 1] - 4, kind="Point")
            pose = bag.make("geometry_msgs/Pose", position=place, orientation=turned)
            still = bag.make("geometry_msgs/Pose", position=bag.vector(kind="Point"), orientation=turned)
            v, w = float(speed(fine[index])), float(rate(fine[index]))
            turning = bag.vector(z=math.nan if 3 < t < 4 else w)
            twist = bag.make("geometry_msgs/Twist", linear=bag.vector(v), angular=turning)
            odometry = {
                "pose": bag.make("geometry_msgs/PoseWithCovariance", pose=still, covariance=many),
                "twist": bag.make("geometry_msgs/TwistWithCovariance", twist=twist, covariance=many),
                "child_frame_id": "base_link",
            }
            imu = {
                "orientation": turned,
                "orientation_covariance": nine,
                "angular_velocity": bag.vector(y=-w),
                "angular_velocity_covariance": nine,
                "linear_acceleration": bag.vector(),
                "linear_acceleration_covariance": nine,
            }
            for topic, kind, frame, fields in (
                ("/odom", "nav_msgs/Odometry", "odom", odometry),
                ("/imu", "sensor_msgs/Imu", "camera_imu_optical_frame", imu),
                ("/mocap", "geometry_msgs/PoseStamped", "world", {"pose": pose}),
            ):
                bag.write(topic, logged, bag.make(kind, header=bag.header(sent, frame), **fields))
    foreign = recording_of(tmp_path / "bag", "bag")
    sources = read_sources(foreign, 100.0)
    found = {(c.source.device, c.source.part): c for c in checked(*sources)}
    assert set(found) == {("/odom", AHEAD), ("/odom", TURN), ("/imu", TURN), ("/mocap", AHEAD), ("/mocap", TURN)}
    for (_, part), one in found.items():
        assert one.reason == "" or "closer" in one.reason
        off = one.steps - (SHORT * TRUE[:, 0] if part == AHEAD else TRUE[:, 2])
        assert np.sqrt(np.nanmean(off**2)) < 0.003
    assert [s.device for s in read_sources(foreign, 100.0, "/imu")] == ["/imu"]
    # In a bag of this project it would be the simulator's truth, which is taken only if it is named.
    ours = recording_of(tmp_path / "bag", "bag of ours")
    assert not read_sources(ours, 100.0) and len(read_sources(ours, 100.0, "/imu")) == 1


CAMERA = floor_camera(90.0, 0.8, 0.3)
"""In lane widths."""
DRAWN = np.random.default_rng(3)
WALL = cv2.GaussianBlur(DRAWN.normal(0.0, 1.0, (256, 2048)).astype(np.float32), (0, 0), 4.0) * 600.0 + 120.0
FLOOR = cv2.GaussianBlur(DRAWN.normal(0.0, 1.0, (1024, 1024)).astype(np.float32), (0, 0), 3.0) * 250.0 + 110.0


def picture(pose: Array, *, wall: bool = True) -> NDArray[np.uint8]:
    """What the camera sees from x, y, yaw: a round wall, and the floor."""
    rows, columns = np.mgrid[0:120, 0:160].astype(float)
    right, down = (columns - CAMERA.centre_x_px) / CAMERA.focal_px[0], (rows - CAMERA.centre_y_px) / CAMERA.focal_px[1]
    cos, sin = math.cos(0.3), math.sin(0.3)
    ahead, left, up = cos - down * sin, -right, -(sin + down * cos)
    yaw = pose[2] + np.arctan2(left, ahead)
    height = up / np.hypot(ahead, left)
    place = np.stack(((yaw % (2 * math.pi)) / (2 * math.pi) * 2047, 255 - 255 * height.clip(0, 1)), -1)
    above = cv2.remap(WALL, place.astype(np.float32), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    reach = 0.8 / np.maximum(-up, 0.02)
    x = pose[0] + reach * (ahead * math.cos(pose[2]) - left * math.sin(pose[2]))
    y = pose[1] + reach * (ahead * math.sin(pose[2]) + left * math.cos(pose[2]))
    cells = np.stack((x * 40 % 1023, y * 40 % 1023), -1).astype(np.float32)
    below = cv2.remap(FLOOR, cells, None, cv2.INTER_LINEAR)
    grey = np.where(up > 0.0, above if wall else 128.0, below).clip(0, 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def test_turns_and_ways_are_found() -> None:
    for turn, way in ((0.0, 0.2), (0.12, 0.3), (-0.15, 0.1), (0.03, 0.0)):
        finder = HintFinder(CAMERA)
        assert np.isinf(finder.see(picture(np.array([3.0, 4.0, 0.4]))).std).all()
        after = np.array([3.0 + way * math.cos(0.4), 4.0 + way * math.sin(0.4), 0.4 + turn])
        hint = finder.see(picture(after))
        assert abs(hint.step[2] - turn) < 0.003 and hint.std[2] < 0.02
        assert abs(hint.step[0] - way) < 0.02 and np.isfinite(hint.std[0])
        assert math.isinf(hint.std[1])


def test_a_plain_sky_and_another_room_say_nothing() -> None:
    finder = HintFinder(CAMERA)
    finder.see(picture(np.array([3.0, 4.0, 0.4]), wall=False))
    assert np.isinf(finder.see(picture(np.array([3.2, 4.0, 0.4]), wall=False)).std).all()
    finder.see(picture(np.array([3.0, 4.0, 0.4])))
    assert np.isinf(finder.see(picture(np.array([3.0, 4.0, 2.4]))).std).all()


def test_a_camera_that_looks_down_says_nothing() -> None:
    finder = HintFinder(replace(CAMERA, pitch_rad=0.9))
    for x in (0.0, 0.1):
        assert np.isinf(finder.see(picture(np.array([x, 0.0, 0.0]))).std).all()
