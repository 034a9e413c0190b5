# SPDX-License-Identifier: Apache-2.0
"""Parts of sentences."""

from __future__ import annotations

import pytest

from ds_base.words import multiple


@pytest.mark.parametrize(
    ("ratio", "said"),
    [(368.4, "368 times"), (8816.0, "8,820 times"), (0.125, "0.125 times"), (0.000421, "0.000421 times")],
)
def test_a_ratio_has_no_exponent(ratio: float, said: str) -> None:
    assert multiple(ratio) == said
