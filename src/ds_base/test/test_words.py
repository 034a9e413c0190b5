# SPDX-License-Identifier: Apache-2.0
"""Parts of sentences."""

from __future__ import annotations

import pytest

from ds_base.words import duration, multiple


@pytest.mark.parametrize(
    ("ratio", "said"),
    [(368.4, "368 times"), (8816.0, "8,820 times"), (0.125, "0.125 times"), (0.000421, "0.000421 times")],
)
def test_a_ratio_has_no_exponent(ratio: float, said: str) -> None:
    assert multiple(ratio) == said


def test_durations_are_short_words() -> None:
    words = ["0 s", "59 s", "1 min 00 s", "3 min 20 s", "1 h 00 min", "5 h 07 min"]
    assert [duration(s) for s in (0.4, 59.4, 60, 200, 3600, 18_440)] == words
