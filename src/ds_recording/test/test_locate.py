# SPDX-License-Identifier: Apache-2.0
"""Recordings of a circular road that is drawn here, and tracks and steering, from closed forms."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from floor_cameras import floor_camera
from numpy.typing import NDArray
from tubs import write_tub

from ds_driver.data.recordings import Reading
from ds_recording import RecordingError
from ds_recording.closing import close_lap
from ds_recording.lines import line_pixels, points_on_floor
from ds_recording.locate import SolvedStretch, located_of, with_odometry
from ds_recording.located import COLUMNS, Located, read_located, write_located
from ds_recording.odometry import AHEAD, TURN, Source
from ds_recording.recording import Views, longest_stretch, read_views
from ds_recording.smoother import Evidence
from ds_recording.steering import follow_steering
from ds_recording.track import Track, read_track, write_track
from ds_report.recording_pages import write_recording_page
from ds_sim.oracle import LaneTracker

Array = NDArray[np.float64]
WIDTH, RADIUS = 0.25, 0.9
"""Lane and radius of the road's centre line, m; driven counter-clockwise."""
CAMERA = floor_camera(90.0, 0.12, 0.25, forward=0.04)
FRAMES = 130
TIMES: Array = 0.05 * np.arange(FRAMES, dtype=np.float64)
SPEED = 0.35


# Truth: offset to the right, heading relative to the road, angle around the circle, and poses of these.
LATERAL: Array = 0.1 + 0.06 * np.sin(TIMES)
HEADING: Array = -np.arctan2(0.06 * np.cos(TIMES), SPEED)
ANGLE = np.concatenate(([0.0], np.cumsum(SPEED * 0.05 / (RADIUS + LATERAL[:-1]))))
POSES: Array = np.stack(
    ((RADIUS + LATERAL) * np.cos(ANGLE), (RADIUS + LATERAL) * np.sin(ANGLE), ANGLE + math.pi / 2 + HEADING), axis=1
)


GRAIN = np.random.default_rng(5).normal(0.0, 1.0, (512, 512)).astype(np.float32)
TEXTURE = cv2.GaussianBlur(GRAIN, (0, 0), 2.0) * 60.0  # no finer than the pixels that show it
PAINTS = {"yellow": (225, 185, 40), "green": (40, 150, 70), "blue": (40, 80, 190)}


def picture(pose: Array, *, lines: bool = True, paint: tuple[int, int, int] = PAINTS["yellow"]) -> NDArray[np.uint8]:
    """What a pinhole without distortion sees of the floor, with four rays a pixel."""
    columns, rows = np.meshgrid((np.arange(320) - 0.5) / 2, (np.arange(240) - 0.5) / 2)
    right, down = (columns - CAMERA.centre_x_px) / CAMERA.focal_px[0], (rows - CAMERA.centre_y_px) / CAMERA.focal_px[1]
    descent = math.sin(0.25) + down * math.cos(0.25)
    reach = 0.12 / np.maximum(descent, 1e-3)
    ahead, left = reach * (math.cos(0.25) - down * math.sin(0.25)) + 0.04, -reach * right
    x = pose[0] + ahead * np.cos(pose[2]) - left * np.sin(pose[2])
    y = pose[1] + ahead * np.sin(pose[2]) + left * np.cos(pose[2])
    offset, along = np.hypot(x, y) - RADIUS, np.arctan2(y, x) * RADIUS
    grain = TEXTURE[(np.floor(x * 200) % 512).astype(int), (np.floor(y * 200) % 512).astype(int)]
    image = np.repeat((80 + grain)[..., None], 3, axis=2)
    if lines:
        image[(np.abs(offset) < 0.012) & (along % 0.2 < 0.12)] = paint
        image[np.abs(np.abs(offset) - WIDTH) < 0.012] = (235, 235, 235)
    image[descent < 0.02] = (120, 150, 200)
    small = cv2.resize(image, (160, 120), interpolation=cv2.INTER_AREA)
    return np.asarray(small.clip(0, 255), np.uint8)


@pytest.fixture(scope="module")
def pictures() -> list[NDArray[np.uint8]]:
    return [picture(pose) for pose in POSES]


def tub_of(folder: Path, images: list[NDArray[np.uint8]], times: Array) -> Path:
    (folder / "images").mkdir(parents=True)
    rows = []
    for index, image in enumerate(images):
        cv2.imwrite(str(folder / "images" / f"{index}.jpg"), image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])
        about = {"_timestamp_ms": round(1e6 + 1000 * float(times[index])), "cam/image_array": f"{index}.jpg"}
        rows.append(about | {"user/mode": "user", "user/angle": 0.0, "user/throttle": 0.3})
    return write_tub(folder, rows)


Solved = tuple[Views, Located, SolvedStretch]


@pytest.fixture(scope="module")
def solved(tmp_path_factory: pytest.TempPathFactory, pictures: list[NDArray[np.uint8]]) -> Solved:
    kept = np.array([i for i in range(FRAMES) if i % 17 != 5])  # frames are missing
    images = [cv2.GaussianBlur(pictures[i], (0, 0), 1.2) if i % 29 == 3 else pictures[i] for i in kept]
    tub = tub_of(tmp_path_factory.mktemp("tub") / "tub", images, TIMES[kept])
    views = read_views(tub, Reading(whole=True))
    return views, *located_of(views, CAMERA, WIDTH)


def test_the_car_is_where_it_was(solved: Solved) -> None:
    found = solved[1]
    times = found.column("time_s")
    index = np.round(times / 0.05).astype(int)
    assert len(index) > 0.95 * len(solved[0].images)
    offset = (found.column("lateral_m") - LATERAL[index]) / WIDTH
    heading = found.column("heading_rad") - HEADING[index]
    assert np.percentile(np.abs(offset), 95) < 0.05
    assert np.degrees(np.sqrt((heading**2).mean())) < 3.0
    assert np.median(found.column("speed_mps")) == pytest.approx(SPEED, rel=0.06)
    points = found.track.points
    rows = np.column_stack((2 * points, np.ones(len(points))))
    centre = np.linalg.lstsq(rows, (points**2).sum(axis=1), rcond=None)[0][:2]
    radii = np.hypot(*(points - centre).T)
    assert np.median(radii) == pytest.approx(RADIUS, rel=0.06)


def test_with_an_encoder_and_a_gyroscope_ways_are_the_true_ones(solved: Solved) -> None:
    """Corners are held back by some percent; a gyroscope that turns the other way changes nothing."""
    views, _, fit = solved
    stamps: Array = np.arange(0.0, TIMES[-1], 0.01)
    frames = np.round(views.seconds / 0.05).astype(int)
    way = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(POSES[:, :2], axis=0).T))))
    ways = Source(name="wheels", device="wheels", part=AHEAD, times=TIMES, values=way)
    turns = Source(name="gyro", device="gyro", part=TURN, times=stamps, values=np.interp(stamps, TIMES, POSES[:, 2]))
    both, checked = with_odometry(fit.evidence, replace(views, odometry=[ways, turns]), CAMERA, WIDTH)
    assert [c.reason for c in checked] == ["", ""]
    true = np.diff(way[frames])

    def error(evidence: Evidence) -> float:
        return float(np.mean([m.step[0] for m in evidence.motions[1:] if m]) * WIDTH / true.mean() - 1.0)

    assert error(fit.evidence) < -0.015 and abs(error(both)) < 0.5 * abs(error(fit.evidence))
    reversed_gyroscope = replace(views, odometry=[replace(turns, values=-turns.values)])
    same, checked = with_odometry(fit.evidence, reversed_gyroscope, CAMERA, WIDTH)
    assert same is fit.evidence and checked[0].reason


def test_the_files_come_back_and_the_page_stands_alone(solved: Solved, tmp_path: Path) -> None:
    views, found, fit = solved
    write_located(tmp_path / "out", found)
    again = read_located(tmp_path / "out")
    np.testing.assert_allclose(again.table, found.table, rtol=1e-5, atol=1e-6)
    assert (tmp_path / "out" / "located.csv").read_text().splitlines()[0] == ",".join(COLUMNS)
    assert again.camera == found.camera and again.lane_width == WIDTH
    about = json.loads((tmp_path / "out" / "recording.json").read_text())
    assert about["kind"] == "tub" and about["calibration"] == "given"
    text = write_recording_page(tmp_path / "page.html", views, found, fit).read_text()
    assert text.count("data:image/png;base64,") == 3 and "http" not in text.replace("http-equiv", "")


@pytest.mark.parametrize("name", ["located.csv", "recording.json", "track.csv", "camera.yaml"])
def test_a_damaged_result_is_refused_in_one_line(solved: Solved, tmp_path: Path, name: str) -> None:
    write_located(tmp_path, solved[1])
    (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:25])
    with pytest.raises(RecordingError) as error:
        read_located(tmp_path)
    assert "\n" not in str(error.value)


def test_a_colour_that_is_not_looked_for_is_refused_before_anything_is_read(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="'pink', expected yellow, green, blue"):
        read_views(tmp_path / "missing", Reading(whole=True), centre="pink")


@pytest.mark.parametrize("wrong", ["shuffled", "nothing moves", "no lane lines"])
def test_images_that_show_no_drive_along_lines_are_refused(
    tmp_path: Path, pictures: list[NDArray[np.uint8]], wrong: str
) -> None:
    images = pictures[:1] * FRAMES
    if wrong == "shuffled":
        images = [pictures[i] for i in np.random.default_rng(3).permutation(FRAMES)]
    if wrong == "no lane lines":
        images = [picture(pose, lines=False) for pose in POSES]
    tub = tub_of(tmp_path / "tub", images, TIMES)
    with pytest.raises(RecordingError, match=wrong):
        located_of(read_views(tub, Reading(whole=True)), CAMERA, WIDTH)


def test_times_that_make_no_sense_are_refused() -> None:
    path = Path("tub")
    even: Array = np.arange(0.0, 25.0, 0.05)
    for seconds, wrong in (
        (even * 0.06, "3 ms apart"),
        (np.random.default_rng(0).permutation(even), "not in the order"),
        (even[:40], "40 of 500"),
        (even + np.floor(even / 2.5), "longest stretch"),
    ):
        with pytest.raises(RecordingError, match=wrong):
            longest_stretch(path, np.asarray(seconds), 500)
    assert longest_stretch(path, np.concatenate((even[:150], 100.0 + even[:300])), 450) == (150, 450)


@pytest.mark.parametrize(("centre", "paint"), [*PAINTS.items(), ("yellow", (200, 60, 40))])
def test_points_of_lines_lie_on_the_lines(centre: str, paint: tuple[int, int, int]) -> None:
    pose = POSES[40]
    image = picture(pose, paint=paint)
    found = points_on_floor(line_pixels(image, 30, centre), CAMERA.scaled(1 / WIDTH))
    other = "blue" if centre == "yellow" else "yellow"
    assert (~points_on_floor(line_pixels(image, 30, other), CAMERA.scaled(1 / WIDTH)).white).sum() < 4
    near = found.floor[:, 0] < 3.0
    x = pose[0] + WIDTH * (found.floor[:, 0] * np.cos(pose[2]) - found.floor[:, 1] * np.sin(pose[2]))
    y = pose[1] + WIDTH * (found.floor[:, 0] * np.sin(pose[2]) + found.floor[:, 1] * np.cos(pose[2]))
    offset = (np.hypot(x, y) - RADIUS) / WIDTH
    assert (near & found.white).sum() > 20 and (near & ~found.white).sum() > 10
    away = np.where(found.white, np.abs(np.abs(offset) - 1.0), np.abs(offset))[near]
    assert np.median(away) < 0.02 and np.percentile(away, 95) < 0.08


ANGLES = np.linspace(0.0, 2.0 * math.pi, 101)[:-1]
CIRCLE = Track(3.0 * np.stack((np.cos(ANGLES), np.sin(ANGLES)), axis=1), True)
"""Driven counter-clockwise."""


def test_places_beside_a_circle_are_those_of_geometry() -> None:
    angle = np.array([0.3, 2.0, 5.5])
    places = np.stack((2.5 * np.cos(angle), 2.5 * np.sin(angle)), axis=1)
    index = CIRCLE.nearest(places, np.array([0, 40, 90]))
    station, offset, heading = CIRCLE.place(places, index)
    np.testing.assert_allclose(station / 3.0, angle, atol=5e-3)
    np.testing.assert_allclose(offset, -0.5, atol=3e-3)  # the inside of a left turn is to the left
    np.testing.assert_allclose(np.cos(heading - angle - math.pi / 2), 1.0, atol=1e-5)


def test_offsets_have_the_sign_of_the_lane_tracker() -> None:
    line = np.stack((np.linspace(0.0, 9.0, 10), np.zeros(10)), axis=1)
    track, place = Track(line), np.array([[4.2, -0.7]])
    offset = track.place(place, track.nearest(place, np.array([3])))[1]
    assert offset[0] == pytest.approx(LaneTracker(line).update(4.2, -0.7)[0]) == pytest.approx(0.7)


def test_resampling_keeps_the_shape() -> None:
    again = CIRCLE.resampled(0.1)
    assert again.pieces == len(again.points) == round(again.length / 0.1)
    np.testing.assert_allclose(np.hypot(*again.points.T), 3.0, atol=2e-3)
    np.testing.assert_allclose(again.curvature, 1.0 / 3.0, atol=0.02)


@pytest.mark.parametrize("closed", [True, False])
def test_a_roboracer_file_comes_back(tmp_path: Path, closed: bool) -> None:
    track = CIRCLE if closed else Track(CIRCLE.points[:60])
    write_track(tmp_path / "track.csv", track, 0.25)
    head, first, *_ = (tmp_path / "track.csv").read_text().splitlines()
    assert (head, first) == ("# x_m,y_m,w_tr_right_m,w_tr_left_m", "3.0000,0.0000,0.2500,0.2500")
    again = read_track(tmp_path / "track.csv")
    assert again.closed is closed
    np.testing.assert_allclose(again.points, track.points, atol=1e-4)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "1,2,3\n",
        "0,0,1,1\n1,nan,1,1\n2,0,1,1\n3,0,1,1\n",
        "a,b,c,d\n",
        "0,0,1,1\n" * 5,
        "# x_m,y_m,w_tr_right_m,w_tr_left_m\n" + "".join(f"{x},2,{x / 10}\n" for x in range(5)),
    ],
)
def test_other_files_are_refused_in_one_line(tmp_path: Path, text: str) -> None:
    (tmp_path / "track.csv").write_text(text)
    with pytest.raises(RecordingError, match="track.csv") as error:
        read_track(tmp_path / "track.csv")
    assert "\n" not in str(error.value)


def ellipse(laps: float, drift: float) -> Track:
    """Ellipse of 5 x 3, which a gyroscope that drifts by so much a lap draws."""
    angles = np.linspace(0.0, 2.0 * math.pi * laps, round(400 * laps))
    points = np.stack((5.0 * np.cos(angles), 3.0 * np.sin(angles)), axis=1)
    steps = np.diff(points, axis=0)
    turned = drift * angles[1:] / (2.0 * math.pi)
    cos, sin = np.cos(turned), np.sin(turned)
    moves = np.stack((cos * steps[:, 0] - sin * steps[:, 1], sin * steps[:, 0] + cos * steps[:, 1]), axis=1)
    return Track(np.vstack((points[:1], points[0] + np.cumsum(moves, axis=0)))).resampled(0.25)


def test_two_laps_of_an_ellipse_close_in_spite_of_drift() -> None:
    track = ellipse(1.6, 0.2)
    along = np.arange(0.5, track.length - 0.5, 0.1)
    lap = close_lap(track, along, np.full(len(along), 0.3), np.zeros(len(along)))
    assert lap is not None
    # Perimeter by Ramanujan's approximation.
    perimeter = math.pi * (24.0 - math.sqrt((15.0 + 3.0) * (5.0 + 9.0)))
    assert lap.track.closed and lap.track.length == pytest.approx(perimeter, rel=0.03)
    _, offset, _ = lap.track.place(lap.poses[:, :2], lap.track.nearest(lap.poses[:, :2], lap.pieces))
    np.testing.assert_allclose(offset, 0.3, atol=0.02)


def test_less_than_a_lap_does_not_close() -> None:
    track = ellipse(0.9, 0.0)
    along = np.arange(0.5, track.length - 0.5, 0.1)
    assert close_lap(track, along, np.zeros(len(along)), np.zeros(len(along))) is None


def test_the_steering_is_found_with_its_delay() -> None:
    rng = np.random.default_rng(0)
    times = np.arange(0.0, 20.0, 0.05)[:400]
    steering = np.repeat(rng.uniform(-1.0, 1.0, 80), 5)
    delayed = np.concatenate((np.zeros(3), steering[:-3]))[:-1]  # 0.15 s
    speeds = 1.0 + 0.3 * np.sin(times[:-1])
    rates = speeds * (-0.8 * delayed + 0.05) + 0.02 * rng.normal(size=399)
    found = follow_steering(times, steering, speeds, rates)
    assert found is not None
    assert found.gain == pytest.approx(-0.8, rel=0.05) and found.trim == pytest.approx(0.05, abs=0.02)
    assert 0.1 <= found.delay + found.lag <= 0.2 and found.explained > 0.95
    assert follow_steering(times, np.full(400, np.nan), speeds, rates) is None
    assert follow_steering(times, rng.permutation(steering), speeds, rates) is None
