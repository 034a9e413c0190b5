"""How well real time was kept, by hand."""

from __future__ import annotations

import pytest

from ds_sim.ros.frame_jitter import FrameJitter


def test_lateness_and_missed_beats() -> None:
    """1, 2, 3 and 1 ms late; two points of the grid went by between the second beat and the third."""
    metronome = FrameJitter(0.05, 100.0)
    for now in (100.051, 100.102, 100.253, 100.301):
        metronome.beat(now)
    assert metronome.beats == 4 and metronome.missed == 2
    assert metronome.lateness(1.0) == pytest.approx(0.003, abs=1e-9)
    assert metronome.lateness(0.5) == pytest.approx(0.0015, abs=1e-9)
    assert str(metronome).startswith("real time: 4 frames at 20 Hz, late by 1.5 ms in the median")
    assert str(metronome).endswith("3.0 ms at worst; 2 frames missed")


def test_nothing_to_tell_before_the_first_beat() -> None:
    assert FrameJitter(0.05, 0.0).lateness(1.0) == 0.0
