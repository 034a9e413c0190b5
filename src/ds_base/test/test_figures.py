# SPDX-License-Identifier: Apache-2.0
"""Figures for screens and for papers: the same values give the same bytes in every format."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np

from ds_base.figures import draw_figure

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
