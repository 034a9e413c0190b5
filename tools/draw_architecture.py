#!/usr/bin/env python3
"""Draw the two pictures of docs/architecture.md as SVG: what flows between the parts, and which package uses which.

Usage: python3 tools/draw_architecture.py [FOLDER]      default: docs/images
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from xml.sax.saxutils import escape

INK, PAPER = "#1f2d3a", "#ffffff"
ROAD, IMAGE, DRIVE = "#2b7a4b", "#b3541e", "#2f5fa8"
"""Colours of what flows: roads, images with the commands that answer them, and finished drives."""
FILLS = {"plain": "#eef2f5", "ros": "#fdf0e4", "science": "#e9f3ec"}


@dataclass
class Picture:
    """An SVG in the making; sizes in pixels."""

    width: int
    height: int
    parts: list[str] = field(default_factory=list)

    def text(self, x: float, y: float, words: str, *, size: int = 13, colour: str = INK, style: str = "") -> None:
        """Write one line, centred on x."""
        self.parts.append(
            f'<text x="{x:g}" y="{y:g}" font-size="{size}" fill="{colour}" text-anchor="middle"{style}>'
            f"{escape(words)}</text>"
        )

    def box(self, x: float, y: float, w: float, h: float, title: str, lines: list[str], fill: str = "plain") -> None:
        """Draw a box with a title and lines below it."""
        self.parts.append(
            f'<rect x="{x:g}" y="{y:g}" width="{w:g}" height="{h:g}" rx="7" fill="{FILLS[fill]}" stroke="{INK}" '
            'stroke-width="1.2"/>'
        )
        top = y + h / 2 - 8.5 * len(lines) + 5
        self.text(x + w / 2, top, title, size=14, style=' font-weight="600"')
        for index, line in enumerate(lines):
            self.text(x + w / 2, top + 17 * (index + 1), line, size=12)

    def arrow(
        self, points: list[tuple[float, float]], colour: str, label: str = "", at: tuple[float, float] = (0, 0)
    ) -> None:
        """Draw a line through points with a head at its end, and its label."""
        path = " ".join(f"{x:g},{y:g}" for x, y in points)
        self.parts.append(
            f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="2" '
            f'marker-end="url(#{colour[1:]})"/>'
        )
        if label:
            self.text(*at, label, size=12, colour=colour)

    def svg(self, title: str) -> str:
        """Return the finished document."""
        heads = "".join(
            f'<marker id="{colour[1:]}" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" '
            f'orient="auto"><path d="M0,0 L8,4 L0,8 z" fill="{colour}"/></marker>'
            for colour in (ROAD, IMAGE, DRIVE, INK)
        )
        body = "\n".join(self.parts)
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {self.width} {self.height}" width="{self.width}" '
            f'height="{self.height}" font-family="Helvetica, Arial, sans-serif" role="img">\n<title>{escape(title)}'
            f'</title>\n<defs>{heads}</defs>\n<rect width="100%" height="100%" rx="10" fill="{PAPER}"/>'
            f"\n{body}\n</svg>\n"
        )


def flow() -> str:
    """Draw the path of a road, of an image and of a drive."""
    p = Picture(960, 470)
    p.box(30, 60, 170, 90, "search", ["DeepHyperion: ask, tell", "ds_orchestrator.search"], "science")
    p.box(300, 60, 190, 90, "campaign", ["which road runs where", "ds_orchestrator.campaign"], "science")
    for index, (title, package) in enumerate(
        (
            ("sibling DS1", "ds_sim_bullet"),
            ("sibling DS2", "ds_sim_softbody"),
            ("sibling DS3", "ds_sim_panda"),
            ("twin DT", "ds_twin_donkey"),
        )
    ):
        p.box(590, 24 + 57 * index, 160, 50, title, [package])
    p.parts.append(
        f'<rect x="575" y="15" width="190" height="240" rx="9" fill="none" stroke="{INK}" stroke-dasharray="5 4"/>'
    )
    p.text(670, 272, "simulator nodes (ds_sim.ros)", size=12)
    p.box(830, 90, 105, 90, "driver", ["your network", "ds_driver"])
    p.box(300, 320, 190, 80, "store", ["campaign.sqlite, bags/", "ds_orchestrator.store"], "science")
    p.box(590, 320, 160, 80, "maps", ["union, merge", "ds_orchestrator.maps"], "science")
    p.box(790, 310, 156, 100, "evaluation", ["against the twin", "report.html", "ds_report"], "science")
    p.arrow([(200, 90), (298, 90)], ROAD, "road", (249, 82))
    p.arrow([(300, 125), (202, 125)], DRIVE, "fitness", (249, 142))
    p.arrow([(490, 90), (573, 90)], ROAD, "road", (532, 82))
    p.text(532, 108, "drive_road", size=11, colour=ROAD)
    p.arrow([(575, 130), (492, 130)], DRIVE, "outcome", (532, 147))
    p.arrow([(765, 115), (828, 115)], IMAGE, "image", (796, 107))
    p.arrow([(830, 155), (767, 155)], IMAGE, "command", (797, 172))
    p.arrow([(395, 150), (395, 318)], DRIVE, "states, commands", (455, 238))
    p.arrow([(490, 360), (588, 360)], DRIVE, "tests", (539, 352))
    p.arrow([(750, 360), (788, 360)], DRIVE)
    for index, (colour, words) in enumerate(
        (
            (ROAD, "path of a road"),
            (IMAGE, "path of an image, 20 times per simulated second"),
            (DRIVE, "path of a drive"),
        )
    ):
        x = (60, 240, 620)[index]
        p.parts.append(f'<line x1="{x}" y1="443" x2="{x + 34}" y2="443" stroke="{colour}" stroke-width="3"/>')
        p.parts.append(f'<text x="{x + 42}" y="448" font-size="13" fill="{INK}">{words}</text>')
    return p.svg("Roads flow from the search to the simulators, images to the driver, drives to store, maps and report")


def _floor(p: Picture, x: float, y: float, width: float, title: str, rooms: str) -> None:
    """Draw a package with its folders side by side below its title."""
    p.parts.append(
        f'<rect x="{x:g}" y="{y:g}" width="{width:g}" height="82" rx="7" fill="{FILLS["science"]}" stroke="{INK}"/>'
    )
    p.text(x + width / 2, y + 24, title, size=14, style=' font-weight="600"')
    names = rooms.split(", ")
    step = (width - 20) / len(names)
    for index, room in enumerate(names):
        left, fill = x + 10 + step * index, FILLS["ros" if room in ("ros", "graph") else "plain"]
        p.parts.append(
            f'<rect x="{left + 3:g}" y="{y + 40:g}" width="{step - 6:g}" height="30" rx="5" fill="{fill}" '
            f'stroke="{INK}"/>'
        )
        p.text(left + step / 2, y + 60, room, size=12)


def packages() -> str:
    """Draw the packages as floors: a package uses those below it, never one above it."""
    floors = (
        ("ds_cli: the command line", "verbs, campaign, prediction, bags, doctor, ros"),
        ("ds_studies: drives that an analysis asks for", "whole campaign, comparison, suite, sensitivity"),
        ("ds_report: shows", "report, pictures, comparison page, watch"),
        ("ds_analysis: reads, never drives", "paper, siblings, comparison, prediction, interchange, common"),
        ("ds_orchestrator: searches, drives, remembers, maps", "search, campaign, store, maps, engines, graph"),
        ("", ""),
        ("ds_bags: recorded runs", "writer, reader, verification, recovery, packs, player, ros"),
        ("ds_sim: what a simulator is", "contract, camera, lane tracker, oracle, session, resimulation, testing, ros"),
    )
    p = Picture(960, 116 + 96 * len(floors))
    for index, (title, rooms) in enumerate(floors):
        y = 16 + 96 * index
        if title:
            _floor(p, 20, y, 920, title, rooms)
        else:
            drivers = "networks, control, data, training, closed_loop, ros"
            _floor(p, 20, y, 540, "ds_driver: networks, data, training, driving", drivers)
            _floor(p, 580, y, 360, "the simulators: ds_sim_*, ds_twin_donkey", "bullet, softbody, panda, donkey")
    y = 16 + 96 * len(floors)
    p.box(20, y, 540, 44, "ds_road: roads as values", [], "science")
    p.box(580, y, 360, 44, "ds_interfaces: messages", [], "ros")
    y += 62
    for x, fill, words in ((60, "science", "plain Python"), (240, "ros", "imports ROS")):
        p.parts.append(f'<rect x="{x}" y="{y}" width="24" height="16" fill="{FILLS[fill]}" stroke="{INK}"/>')
        p.parts.append(f'<text x="{x + 34}" y="{y + 13}" font-size="13" fill="{INK}">{words}</text>')
    p.parts.append(f'<text x="420" y="{y + 13}" font-size="13" fill="{INK}">a package uses those below it only</text>')
    return p.svg("Packages as floors: a package uses those below it; green is plain Python, orange imports ROS")


PICTURES = {"architecture_flow.svg": flow, "architecture_packages.svg": packages}


def main() -> int:
    """Write the pictures; the result is the exit status."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).resolve().parents[1] / "docs/images"
    for name, draw in PICTURES.items():
        (folder / name).write_text(draw())
    return 0


if __name__ == "__main__":
    sys.exit(main())
