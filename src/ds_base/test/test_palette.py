# SPDX-License-Identifier: Apache-2.0
"""Colours stay apart for the colour blind: differences in CIE Lab of the colours as they see them."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from numpy.typing import NDArray

from ds_base.palette import BETWEEN, FAIL, FAIL_ON_DARK, PASS, SERIES, colour_of_share, ink_on, luminance, rgb

VISION = {
    "normal": np.eye(3),
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]],
}
"""Linear RGB as others see it (Machado, Oliveira, Fernandes 2009, severity 1)."""
XYZ = np.array([[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.072175], [0.0193339, 0.119192, 0.9503041]])
WHITE = np.array([0.95047, 1.0, 1.08883])


def lab(colour: str, vision: str) -> NDArray[np.float64]:
    """CIE Lab of an sRGB colour as it is seen (IEC 61966-2-1; CIE 15)."""
    values = np.array(rgb(colour)) / 255
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    x, y, z = np.cbrt(XYZ @ np.clip(np.array(VISION[vision]) @ linear, 1e-3, 1.0) / WHITE)
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("vision", VISION)
def test_failure_pass_and_simulators_are_told_apart(vision: str) -> None:
    """A just noticeable difference is 2.3 (Mahy, Van Eycken, Oosterlinck 1994)."""

    def least(one: str, *others: str) -> float:
        return min(float(np.linalg.norm(lab(one, vision) - lab(other, vision))) for other in others)

    assert least(FAIL, PASS, BETWEEN, *SERIES) > 30.0
    assert least(PASS, BETWEEN, *SERIES) > 20.0
    assert min(least(*pair) for pair in combinations(SERIES, 2)) > 15.0


def test_failures_are_legible_as_text_and_numbers_on_every_share() -> None:
    def contrast(*colours: tuple[int, int, int]) -> float:
        dark, light = sorted(map(luminance, colours))
        return (light + 0.05) / (dark + 0.05)

    assert contrast(rgb(FAIL), (255, 255, 255)) >= 4.5 and contrast(rgb(FAIL_ON_DARK), (27, 31, 36)) >= 4.5
    for share in np.linspace(0.0, 1.0, 21):
        assert contrast(colour_of_share(share), ink_on(colour_of_share(share))) >= 4.0
    assert [colour_of_share(share) for share in (-1.0, 0.5, 2.0)] == [rgb(PASS), rgb(BETWEEN), rgb(FAIL)]
