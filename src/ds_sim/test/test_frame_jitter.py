# SPDX-License-Identifier: Apache-2.0
"""Compares the jitter statistics of real-time frames with values worked out by hand."""

from __future__ import annotations

import pytest

from ds_sim.ros.real_time_loop import FrameJitter


def test_lateness_and_missed_beats() -> None:
    """Frames 1, 2, 3 and 1 ms late; two frames were missed between the second and the third."""
    jitter = FrameJitter(0.05, 100.0)
    for now in (100.051, 100.102, 100.253, 100.301):
        jitter.beat(now)
    assert jitter.beats == 4 and jitter.missed == 2
    assert jitter.lateness(1.0) == pytest.approx(0.003, abs=1e-9)
    assert jitter.lateness(0.5) == pytest.approx(0.0015, abs=1e-9)
    assert str(jitter).startswith("real time: 4 frames at 20 Hz, late by 1.5 ms in the median")
    assert str(jitter).endswith("3.0 ms at worst; 2 frames missed")


def test_lateness_is_zero_before_the_first_beat() -> None:
    assert FrameJitter(0.05, 0.0).lateness(1.0) == 0.0
