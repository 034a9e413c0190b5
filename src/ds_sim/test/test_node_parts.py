# SPDX-License-Identifier: Apache-2.0
"""Parts of a simulator's node: commands that spoil a run, by their stamps, and the lateness of frames."""

from __future__ import annotations

import pytest

from ds_sim.ros.command_monitor import WARN_AFTER, CommandMonitor, FrameJitter
from ds_sim.simulator import CommandError, Reason


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
