# SPDX-License-Identifier: Apache-2.0
"""Assignment of other stacks' commands to frames."""

from __future__ import annotations

import pytest

from ds_driver.control.other_stacks import StampMatcher

STEP = 50_000_000


def test_a_stamped_command_answers_its_frame_in_either_order() -> None:
    matching: StampMatcher[str, str] = StampMatcher()
    assert matching.frame(STEP, "a") is None
    assert matching.command(STEP, "left") == ("a", "left")
    assert matching.command(2 * STEP, "right") is None
    assert matching.frame(2 * STEP, "b") == ("b", "right")


def test_repeated_late_and_unknown_stamps_are_refused() -> None:
    matching: StampMatcher[str, str] = StampMatcher()
    matching.frame(STEP, "a")
    matching.command(STEP, "left")
    for stamp in (STEP, STEP // 2, 1_700_000_000 * 10**9):
        with pytest.raises(KeyError):
            matching.command(stamp, "again")
    assert matching.frame(2 * STEP, "b") is None


def test_a_command_without_stamp_answers_the_newest_frame_once_or_the_next() -> None:
    matching: StampMatcher[str, str] = StampMatcher()
    matching.frame(STEP, "a")
    matching.frame(2 * STEP, "b")
    assert matching.command(0, "left") == ("b", "left")
    assert matching.command(0, "right") is None
    assert matching.command(0, "straight") is None
    assert matching.frame(3 * STEP, "c") == ("c", "straight")
    assert matching.frame(4 * STEP, "d") is None


def test_a_repeated_frame_can_be_answered_again() -> None:
    matching: StampMatcher[str, str] = StampMatcher()
    for _ in range(2):
        assert matching.frame(STEP, "a") is None
        assert matching.command(STEP, "left") == ("a", "left")


def test_memory_is_bounded() -> None:
    matching: StampMatcher[int, int] = StampMatcher()
    for number in range(1, 2000):
        matching.frame(number * STEP, number)
    assert len(matching._frames) <= 20
    matching = StampMatcher()
    for number in range(1, 2000):
        matching.command(number * STEP, number)
    assert len(matching._early) <= 20
