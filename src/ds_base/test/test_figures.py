# SPDX-License-Identifier: Apache-2.0
"""Figures have the same bytes in every format, and colours stay apart for the colour blind; words of numbers."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np
import pytest
from numpy.typing import NDArray

from ds_base.figures import draw_figure
from ds_base.palette import BETWEEN, FAIL, FAIL_ON_DARK, PASS, SERIES, colour_of_share, ink_on, luminance, rgb
from ds_base.words import duration, multiple

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LINE = "{http://www.w3.org/2000/svg}path"


def draw(figure: Figure) -> None:
    axes = figure.subplots()
    axes.plot([0.0, 1.0], [0.0, 1.0], color="#d55e00", gid="diagonal")
    axes.set_title("failures, $")


def test_a_figure_is_written_as_pdf_and_svg_twice_with_the_same_bytes(tmp_path: Path) -> None:
    pixels = [draw_figure(400, 300, draw, tmp_path / name) for name in ("one.png", "two.png")]
    assert pixels[0].shape == (300, 400, 3) and (pixels[0] == pixels[1]).all()
    assert (pixels[0] == draw_figure(400, 300, draw)).all()
    for suffix in ("pdf", "svg"):
        assert (tmp_path / f"one.{suffix}").read_bytes() == (tmp_path / f"two.{suffix}").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one.pdf", "one.svg", "two.pdf", "two.svg"]
    assert (tmp_path / "one.pdf").read_bytes().startswith(b"%PDF-")
    svg = ElementTree.parse(tmp_path / "one.svg").getroot()
    assert svg.attrib["viewBox"] == "0 0 288 216"  # 400 x 300 pixels in points of 1/72 inch
    (line,) = svg.findall(f".//*[@id='diagonal']/{LINE}")
    ends = np.array([float(word) for word in line.attrib["d"].split() if word not in "ML"]).reshape(-1, 2)
    assert ends[1, 0] > ends[0, 0] and ends[1, 1] < ends[0, 1]  # rises to the right; y points down


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


@pytest.mark.parametrize(
    ("ratio", "said"),
    [(368.4, "368 times"), (8816.0, "8,820 times"), (0.125, "0.125 times"), (0.000421, "0.000421 times")],
)
def test_a_ratio_has_no_exponent(ratio: float, said: str) -> None:
    assert multiple(ratio) == said


def test_durations_are_short_words() -> None:
    words = ["0 s", "59 s", "1 min 00 s", "3 min 20 s", "1 h 00 min", "5 h 07 min"]
    assert [duration(s) for s in (0.4, 59.4, 60, 200, 3600, 18_440)] == words
