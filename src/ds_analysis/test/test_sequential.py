# SPDX-License-Identifier: Apache-2.0
"""Evidence that holds at any time: coverage under stopping rules that try to break it, and drives that it saves."""

from __future__ import annotations

import numpy as np
import pytest
from compared_drives import NEW, OLD, pairs

from ds_analysis.comparison.analysis import answer_of, compare_networks, is_sure
from ds_analysis.comparison.paired_drives import sequential_evidence
from ds_sim.registry import SimulatorName


def test_bets_multiply_as_their_definition_says() -> None:
    """Against no difference, a newly failing test pays 1 + c to who bets on it, 1 - c to who bets against it."""
    stakes = (0.2, 0.5, 0.95)
    capital = [1.0]
    for n in (1, 2, 3):
        capital.append(sum((1 + c) ** n + (1 - c) ** n for c in stakes) / 6)
    assert sequential_evidence((1, 1, 1))[0] == pytest.approx(1 / max(capital))
    assert sequential_evidence(()) == (1.0, (-1.0, 1.0))
    p, (low, high) = sequential_evidence((-1,) * 12)
    assert p < 0.05 and low == -1.0 and high < 0.0
    assert sequential_evidence((1,) * 9 + (0,) * 100)[0] < 0.05  # what was sure stays sure


@pytest.mark.parametrize(("newly", "fixed"), [(0.0, 0.0), (0.1, 0.1), (0.3, 0.3), (0.3, 0.0), (0.05, 0.2)])
def test_the_truth_is_hardly_ever_missed_by_who_stops_when_it_suits(newly: float, fixed: float) -> None:
    """Looking after each of 60 tests, and stopping at the worst moment: at most 5%, and the noise of 400 series."""
    rng = np.random.default_rng(37)
    draws = rng.choice([1, -1, 0], size=(400, 60), p=[newly, fixed, 1 - newly - fixed])
    missed = false = 0
    for series in draws:
        looks = [sequential_evidence(tuple(map(int, series[:n]))) for n in range(5, 61, 5)]
        missed += any(not low - 0.005 <= newly - fixed <= high + 0.005 for _, (low, high) in looks)
        false += newly == fixed and any(p < 0.05 for p, _ in looks)
    assert missed <= 400 * 0.08 and false <= 400 * 0.08


def test_an_answer_is_sure_when_it_is_worse_somewhere_or_bounded_everywhere() -> None:
    def compared(*counts: tuple[int, int, int, int]) -> tuple[bool, str]:
        drives = [drive for k, one in enumerate(counts) for drive in pairs(f"sim{k}", one)]
        names = [SimulatorName(f"sim{k}") for k in range(len(counts))]
        found = compare_networks(
            drives, reference=OLD, candidate=NEW, origin="random", source="roads", simulators=names, sequential=True
        )
        return is_sure(found), answer_of(found)

    assert compared((15, 0, 0, 5), (0, 0, 0, 20)) == (True, "Merge? No: it is worse.")
    assert not compared((3, 0, 0, 17), (0, 0, 0, 20))[0]
    assert not compared((0, 0, 2, 18))[0]
    sure, answer = compared((0, 0, 2, 78), (0, 0, 0, 80))
    assert sure and "Nothing speaks against it" in answer
    assert "at most 10 more" in answer or int(answer.split("at most ")[1].split()[0]) <= 10
