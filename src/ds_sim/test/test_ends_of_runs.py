# SPDX-License-Identifier: Apache-2.0
"""When a run ends: lane positions and verdicts by hand, commands that spoil it, and the lateness of frames."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ds_sim.oracle import LaneTracker, Oracle
from ds_sim.ros.command_monitor import WARN_AFTER, CommandMonitor, FrameJitter
from ds_sim.simulator import CommandError, Outcome, Reason


def test_right_is_positive_and_arc_length_counts_along_the_line() -> None:
    tracker = LaneTracker(np.array([(0.0, 0.0), (10.0, 0.0), (10.0, 10.0)]))
    assert tracker.length == 20.0
    assert tracker.update(4.0, -1.5) == pytest.approx((1.5, 4.0))
    assert tracker.update(8.0, 0.5) == pytest.approx((-0.5, 8.0))
    assert tracker.update(10.75, 6.0) == pytest.approx((0.75, 16.0))
    assert tracker.lateral_position(9.0, 7.0) == pytest.approx(-1.0)


def test_the_line_is_extended_straight_at_both_ends() -> None:
    tracker = LaneTracker(np.array([(0.0, 0.0), (10.0, 0.0)]))
    assert tracker.update(-3.0, -1.0) == pytest.approx((1.0, -3.0))
    assert tracker.update(13.0, 1.0) == pytest.approx((-1.0, 13.0))


def test_another_part_of_the_road_close_by_is_not_matched() -> None:
    """On a hairpin with legs 6 m apart, a vehicle that drifts sideways is still tracked on the first leg."""
    up = [(0.0, float(y)) for y in range(41)]
    bend = [(3 - 3 * math.cos(a), 40 + 3 * math.sin(a)) for a in np.linspace(0.1, math.pi - 0.1, 12)]
    down = [(6.0, float(y)) for y in range(40, -1, -1)]
    tracker = LaneTracker(np.array([*up, *bend, *down]))
    for step in range(60):
        lateral, arc = tracker.update(step * 0.08, step * 0.3)
        assert lateral == pytest.approx(step * 0.08) and arc == pytest.approx(step * 0.3)


@pytest.mark.parametrize(
    ("distance", "arc", "outcome"),
    [
        (0.5, 10.0, Outcome.RUNNING),
        (0.0, 10.0, Outcome.RUNNING),
        (-1e-9, 10.0, Outcome.OUT_OF_BOUNDS),
        (0.1, 98.0, Outcome.COMPLETED),
        (-0.1, 99.0, Outcome.OUT_OF_BOUNDS),
    ],
)
def test_verdicts_on_one_frame(distance: float, arc: float, outcome: Outcome) -> None:
    assert Oracle(100.0).judge(step=1, lateral_distance=distance, arc_length=arc) is outcome


def test_less_than_a_metre_in_ten_seconds_is_stuck() -> None:
    oracle = Oracle(100.0)
    verdicts = [oracle.judge(step=k, lateral_distance=1.0, arc_length=k * 0.0049) for k in range(201)]
    assert verdicts[:-1] == [Outcome.RUNNING] * 200 and verdicts[-1] is Outcome.STUCK
    oracle = Oracle(100.0)
    assert {oracle.judge(step=k, lateral_distance=1.0, arc_length=k * 0.0051) for k in range(201)} == {Outcome.RUNNING}


def test_reaching_the_maximum_of_steps_is_a_timeout() -> None:
    oracle = Oracle(100.0)
    assert oracle.judge(step=1999, lateral_distance=1.0, arc_length=1.0) is Outcome.RUNNING
    assert oracle.judge(step=2000, lateral_distance=1.0, arc_length=5.0) is Outcome.TIMEOUT


def test_outcomes_are_verdicts_or_errors() -> None:
    assert [o.name for o in Outcome if o.is_failure] == ["OUT_OF_BOUNDS", "STUCK", "TIMEOUT"]
    assert [o.name for o in Outcome if o.is_error] == ["DRIVER_SILENT", "SIM_ERROR", "CANCELLED"]
    assert [o.name for o in Outcome if o.is_verdict] == ["COMPLETED", "OUT_OF_BOUNDS", "STUCK", "TIMEOUT"]


@pytest.mark.parametrize(
    ("sequences", "two"),
    [
        ([1, 2, 3, 4], False),
        ([7, 9, 12], False),  # commands that were lost on the way
        ([40, 41, 1, 2, 3], False),  # restarted during the run
        ([1, 1, 2, 2], True),  # both are new
        ([500, 3, 501, 4], True),  # one of them drove before
        ([5, 6, 7, 1, 8, 2], True),  # the second one joins later
        ([None, None], False),  # a middleware without sequence numbers
    ],
)
def test_two_drivers_are_told_from_one_that_was_restarted(sequences: list[int | None], two: bool) -> None:
    monitor = CommandMonitor()
    for sequence in sequences:
        monitor.command(sequence)
    assert monitor.two_drivers is two


def test_a_driver_that_ignores_images_is_reported_once_and_named_in_the_result() -> None:
    monitor = CommandMonitor()
    monitor.frame(1)
    warnings = [monitor.stray(0) for _ in range(2 * WARN_AFTER)]
    assert warnings.count(True) == 1
    message, reason = monitor.silence(5.0, 7)
    assert reason is Reason.WRONG_STAMP and "header" in message
    assert message.startswith(f"no command within 5 s after frame 7; {2 * WARN_AFTER} commands came")


def test_second_answers_to_the_frame_before_are_no_reason_for_silence() -> None:
    monitor = CommandMonitor()
    monitor.frame(1)
    monitor.frame(1)  # sent again
    monitor.frame(2)
    assert not monitor.stray(1)
    assert monitor.silence(0.5, 0) == ("no command within 0.5 s after frame 0", Reason.NONE)


def test_an_invalid_command_is_the_reason_for_silence() -> None:
    monitor = CommandMonitor()
    monitor.frame(1)
    monitor.stray(0)
    monitor.refused(CommandError("steering is nan"))
    assert monitor.silence(2.0, 1) == (
        "no command within 2 s after frame 1; the last command was refused: steering is nan",
        Reason.COMMAND_REFUSED,
    )


def test_lateness_and_missed_beats() -> None:
    """Frames 1, 2, 3 and 1 ms late; two frames were missed between the second and the third."""
    jitter = FrameJitter(0.05, 100.0)
    for now in (100.051, 100.102, 100.253, 100.301):
        jitter.beat(now)
    assert jitter.missed == 2
    assert jitter.lateness(1.0) == pytest.approx(0.003, abs=1e-9)
    assert jitter.lateness(0.5) == pytest.approx(0.0015, abs=1e-9)
    assert str(jitter).startswith("real time: 4 frames at 20 Hz, late by 1.5 ms in the median")
    assert str(jitter).endswith("3.0 ms at worst; 2 frames missed")


def test_lateness_is_zero_before_the_first_beat() -> None:
    assert FrameJitter(0.05, 0.0).lateness(1.0) == 0.0
