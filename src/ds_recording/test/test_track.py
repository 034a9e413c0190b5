# SPDX-License-Identifier: Apache-2.0
import math
from pathlib import Path

import numpy as np
import pytest

from ds_recording import RecordingError
from ds_recording.first_guess import close_lap
from ds_recording.steering import follow_steering
from ds_recording.track import Track, read_track, write_track
from ds_sim.oracle import LaneTracker

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
