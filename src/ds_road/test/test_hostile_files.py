# SPDX-License-Identifier: Apache-2.0
"""Road files of a stranger: whatever they hold, one line comes back within seconds, and without much memory."""

from __future__ import annotations

import json
import re
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

ENTITY = '<!DOCTYPE x [<!ENTITY a "b">]><OpenDRIVE>&a;</OpenDRIVE>'
LINE = '<planView><geometry s="0" x="50" y="50" hdg="0" length="{}"><line/></geometry></planView>'
PIECE = '<geometry s="0" x="50" y="50" hdg="0" length="1"><line/></geometry>'
STEPS = '<userData code="digital_siblings_steps_per_piece" value="100"/>'
WIDTH = '<width sOffset="{}" a="4" b="0" c="0" d="0"/>'
SECTION = '<laneSection s="{}"><right><lane id="-1" type="driving">{}</lane></right></laneSection>'


def opendrive(view: str, sections: str, *, before: str = "") -> str:
    return f'<OpenDRIVE><road id="1">{before}{view}<lanes>{sections}</lanes></road></OpenDRIVE>'


def zigzag(count: int) -> str:
    """A lanelet whose two bounds cross each other at every point, so that geometry libraries find many crossings."""

    def bound(tag: str, x: int) -> str:
        points = (f"<point><x>{k * x * 37 % 250}</x><y>{k * 91 * x % 249}</y></point>" for k in range(count))
        return f"<{tag}>{''.join(points)}</{tag}>"

    return f'<lanelet id="1">{bound("leftBound", 53)}{bound("rightBound", 59)}</lanelet>'


def scenario(content: str) -> str:
    start = "<initialState><position><point><x>1</x><y>1</y></point></position></initialState>"
    return f'<commonRoad commonRoadVersion="2020a">{content}<planningProblem>{start}</planningProblem></commonRoad>'


def lanelets(count: int) -> str:
    bounds = "".join(
        f"<{side}Bound><point><x>{x}</x><y>0</y></point><point><x>{x}</x><y>9</y></point></{side}Bound>"
        for side, x in (("left", 0), ("right", 4))
    )
    return "".join(f'<lanelet id="{n}">{bounds}<successor ref="{n + 1}"/></lanelet>' for n in range(count))


HOSTILE: dict[str, tuple[Callable[[], bytes], str]] = {
    "UTF-16 with a document type": (lambda: ENTITY.encode("utf-16-le"), "document type"),
    "crossing bounds": (lambda: scenario(zigzag(3000)).encode(), "3000 points"),
    "crossing bounds within the limit": (lambda: scenario(zigzag(1000)).encode(), "."),
    "a long chain of lanelets": (lambda: scenario(lanelets(60_000)).encode(), "lanelets, expected at most"),
    "many widths": (
        lambda: opendrive(LINE.format(900), SECTION.format(0, "".join(map(WIDTH.format, range(200_000))))).encode(),
        "expected at most",
    ),
    "many sections over many samples": (
        lambda: opendrive(
            f"<planView>{PIECE * 1000}</planView>",
            "".join(SECTION.format(1e9 * (k % 2), WIDTH.format(0) * 100) for k in range(1000)),
            before=STEPS,
        ).encode(),
        ".",
    ),
    "many elements": (lambda: b"<OpenDRIVE>" + b"<a/>" * 4_000_000 + b"</OpenDRIVE>", "elements"),
    "a sparse road of a million kilometres": (
        lambda: json.dumps({"road_points": [[1e6 * (-1) ** k, k] for k in range(1000)]}).encode(),
        "expected 2 to 1000",
    ),
    "many tests": (lambda: json.dumps([{"road_points": [[0, 0], [1, 1]]}] * 200_000).encode(), "expected at most"),
}


READ = """
import sys
from pathlib import Path
from ds_road import RoadError
from ds_road.importing import import_roads
try:
    import_roads(Path(sys.argv[1]))
except RoadError as error:
    print(error)
"""


def limit() -> None:
    """Allow 20 s of processor time and 2 GiB of memory."""
    resource.setrlimit(resource.RLIMIT_CPU, (20, 20))
    resource.setrlimit(resource.RLIMIT_AS, (2 * 2**30, 2 * 2**30))


@pytest.mark.parametrize("what", HOSTILE)
def test_a_hostile_road_gets_one_line_in_bounded_time_and_memory(what: str, tmp_path: Path) -> None:
    make, words = HOSTILE[what]
    path = tmp_path / "road"
    path.write_bytes(make())
    command = [sys.executable, "-c", READ, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, preexec_fn=limit, check=False)
    assert done.returncode == 0, (done.returncode, done.stderr[-500:])
    assert len(done.stdout.splitlines()) == 1 and len(done.stdout) < 500
    assert re.search(words, done.stdout.removeprefix(str(path))), done.stdout
