# SPDX-License-Identifier: Apache-2.0
"""Imported roads against closed forms; exported ones, imported again, and against ASAM's schema and another reader."""

from __future__ import annotations

import json
import math
import re
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
import shapely

from ds_base.left_out import LeftOut
from ds_road import Road, RoadError, Side, generate, read_roads
from ds_road.importing import import_roads
from ds_road.opendrive import SPACING, opendrive, write_all

ROADS = {
    "random": generate(np.random.default_rng(3)),
    "tight": generate(np.random.default_rng(8), max_angle=300),
    "maxitwo": Road(generate(np.random.default_rng(5)).control_points, maxitwo_compatible=True),
    "straight": Road([(125.0, 25.0 * i) for i in range(9)]),
    "sampled": Road.from_road_points(generate(np.random.default_rng(7)).points, lane_width=3.0),
    "left": generate(np.random.default_rng(9), lane="left"),
    "middle": generate(np.random.default_rng(3)).in_lane("middle"),
    "single": generate(np.random.default_rng(3)).in_lane("single"),
}


WITH_LANES_ASIDE = [name for name, road in ROADS.items() if road.lane in ("right", "left")]


@pytest.mark.parametrize("name", ROADS)
def test_what_was_exported_comes_back(name: str, tmp_path: Path) -> None:
    road = ROADS[name]
    (path,) = write_all([road], [name], tmp_path)
    (back,) = import_roads(path)
    assert back.name == name and back.moved == (0.0, 0.0)
    assert (back.road.lane, back.road.lane_width) == (road.lane, road.lane_width)
    assert back.road.points == pytest.approx(road.points, abs=1e-6)
    assert back.road.right_edge == pytest.approx(road.right_edge, abs=1e-4)
    assert int(100 * back.road.curvature) == int(100 * road.curvature) and back.road.turns_count == road.turns_count
    (tmp_path / "again.json").write_text(json.dumps([back.to_json()]))
    assert read_roads(tmp_path / "again.json") == [back.road]


XODR = """<?xml version="1.0"?><OpenDRIVE><header revMajor="1" revMinor="4"/>
<road name="r" length="{length}" id="1" junction="-1"><planView>{pieces}</planView>
<lanes>{offset}<laneSection s="0"><left>{left}</left><center><lane id="0" type="none"/></center>
<right>{right}</right></laneSection></lanes></road></OpenDRIVE>"""
LANE = '<lane id="{}" type="{}"><{} sOffset="0" a="{}" b="{}" c="0" d="0"/></lane>'


def xodr(*pieces: tuple[Any, ...], **changed: Any) -> str:
    texts = [
        f'<geometry s="{s}" x="{x}" y="{y}" hdg="{h}" length="{n}">{shape}</geometry>'
        for s, x, y, h, n, shape in pieces
    ]
    lane = LANE.format(-1, "driving", "width", changed.pop("width", 3.5), changed.pop("slope", 0.0))
    values = {"offset": "", "left": "", "right": lane, **changed}
    return XODR.format(length=sum(piece[4] for piece in pieces), pieces="".join(texts), **values)


def imported(text: str, tmp_path: Path, suffix: str = "xodr") -> Road:
    (tmp_path / f"road.{suffix}").write_text(text)
    (found,) = import_roads(tmp_path / f"road.{suffix}")
    return found.road


def test_lines_and_arcs_are_where_geometry_says(tmp_path: Path) -> None:
    """A straight of 30 m to the north, then a quarter of a circle of 40 m to the left."""
    arc = 20.0 * np.pi
    line = (0, 100, 50, np.pi / 2, 30, "<line/>")
    road = imported(xodr(line, (30, 100, 80, np.pi / 2, arc, '<arc curvature="0.025"/>')), tmp_path)
    assert road.lane_width == 3.5 and road.lane == "right"
    straight, bend = road.points[road.points[:, 1] <= 80.0], road.points[road.points[:, 1] > 80.0]
    assert np.abs(straight[:, 0] - 100.0).max() < 1e-9 and straight[0] == pytest.approx((100.0, 50.0))
    assert np.abs(np.hypot(bend[:, 0] - 60.0, bend[:, 1] - 80.0) - 40.0).max() < 1e-9
    assert road.points[-1] == pytest.approx((60.0, 120.0))
    assert np.hypot(*np.diff(road.points, axis=0).T).max() <= SPACING + 1e-9


def test_a_spiral_is_eulers(tmp_path: Path) -> None:
    """From curvature 0 to 1/R over L: its end by the series of the Fresnel integrals (Bronstein)."""
    length, radius = 40.0, 30.0
    shape = f'<spiral curvStart="0" curvEnd="{1 / radius}"/>'
    road = imported(xodr((0, 50, 50, 0.0, length, shape)), tmp_path)
    turn = length / (2 * radius)
    x = length * (1 - turn**2 / 10 + turn**4 / 216 - turn**6 / 9360 + turn**8 / 685440)
    y = length * (turn / 3 - turn**3 / 42 + turn**5 / 1320 - turn**7 / 75600)
    assert road.points[-1] - road.points[0] == pytest.approx((x, y), abs=1e-4)


def test_a_lane_offset_shifts_the_line_and_roads_outside_of_the_box_move_in(tmp_path: Path) -> None:
    text = xodr((0, 5000.0, -70.0, 0.0, 100, "<line/>"), offset='<laneOffset s="0" a="2" b="0" c="0" d="0"/>')
    (tmp_path / "road.xodr").write_text(text)
    (found,) = import_roads(tmp_path / "road.xodr")
    assert found.moved == (75.0 - 5000.0, 125.0 + 68.0)
    assert np.abs(found.road.points[:, 1] - 125.0).max() < 1e-9 and found.road.validity.valid


def test_sparse_road_points_are_interpolated_and_dense_ones_kept(tmp_path: Path) -> None:
    angles = np.linspace(0.0, np.pi, 13)
    circle = np.stack((125 + 60 * np.cos(angles), 100 + 60 * np.sin(angles)), axis=1)
    road = imported(json.dumps({"road_points": circle.tolist()}), tmp_path, "json")
    assert np.abs(np.hypot(*(road.points - (125, 100)).T) - 60.0).max() < 0.05
    assert np.hypot(*np.diff(road.points, axis=0).T).max() < SPACING * 1.1
    dense = [[*point, 0.0, 8.0] for point in road.points.tolist()]
    kept = imported(json.dumps({"road_points": circle.tolist(), "interpolated_points": dense}), tmp_path, "json")
    assert (kept.points == road.points).all()


START = "<planningProblem><initialState><position><point><x>51</x><y>35</y></point></position></initialState>"


def lanelets(start: str = f"{START}</planningProblem>", left: float = 50.0, right: float = 53.0) -> str:
    """CommonRoad with three lanelets in a row, from y = 10, 30 and 50 m on, each 20 m long."""

    def bound(tag: str, x: float, begin: float) -> str:
        points = "".join(f"<point><x>{x}</x><y>{begin + 2 * k}</y></point>" for k in range(11))
        return f"<{tag}>{points}</{tag}>"

    row = "".join(
        f'<lanelet id="{n}">{bound("leftBound", left, b)}{bound("rightBound", right, b)}'
        f'{f"""<successor ref="{n + 1}"/>""" if n < 4 else ""}</lanelet>'
        for n, b in ((2, 10.0), (3, 30.0), (4, 50.0))
    )
    return f'<commonRoad commonRoadVersion="2018b">{row}{start}</commonRoad>'


def test_a_chain_of_lanelets_is_followed_from_the_planning_problem(tmp_path: Path) -> None:
    road = imported(lanelets(), tmp_path, "xml")
    assert road.lane_width == 3.0 and road.lane == "right"
    assert road.points[0] == pytest.approx((50.0, 30.0)) and road.points[-1] == pytest.approx((50.0, 70.0))
    assert imported(lanelets(""), tmp_path, "xml").points[0] == pytest.approx((50.0, 10.0))


@pytest.mark.parametrize(("side", "lane", "x"), [("Left", "right", 50.0), ("Right", "left", 53.0)])
def test_the_centre_line_is_beside_the_oncoming_lanelet(side: str, lane: Side, x: float, tmp_path: Path) -> None:
    beside = f'</rightBound><adjacent{side} ref="9" drivingDir="opposite"/>'
    road = imported(lanelets().replace("</rightBound>", beside), tmp_path, "xml")
    assert road.lane == lane and (road.points[:, 0] == x).all()


LINE = (0, 50, 50, 0.0, 100, "<line/>")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("hello", "not a track: expected at least two lines x,y"),
        ("1,2\n3,4\n5", "line 3 is '5', expected numbers as in the lines before"),
        ("s,psi\n1,2\n3,4", "columns s, psi: expected x and y"),
        ("1,2\n3,nan\n5,6", "row 2 of the track has no finite x and y"),
        ("<a", "not XML"),
        ("<a/>", "XML of 'a': expected OpenDRIVE or commonRoad"),
        ('<!DOCTYPE x [<!ENTITY a "b">]><OpenDRIVE/>', "XML with a document type"),
        ("<OpenDRIVE/>", "without roads outside of junctions"),
        ('<OpenDRIVE><road id="7"/></OpenDRIVE>', "road '7': it has no planView"),
        (xodr((0, 50, 50, 0.0, 100, "<poly3/>")), "its geometry has poly3: expected line, arc"),
        (xodr((0, 50, "nan", 0.0, 100, "<line/>")), "y of geometry is 'nan', expected a number"),
        (xodr((0, 50, 50, 0.0, -1, "<line/>")), "length -1"),
        (xodr((0, 50, 50, 0.0, 1e300, "<line/>")), "longer than 10000 m"),
        (xodr((0, 50, 50, 0.0, 100, "<arc/>")), "curvature of arc is ''"),
        (xodr(LINE, slope=0.01), "the lane is 3.50 to 4.50 m wide"),
        (xodr(LINE, width=300), "lane width is 300"),
        (xodr(LINE).replace('id="-1" type="driving"', 'id="-1" type="border"'), "no driving lane from 0 m on"),
        ('<commonRoad commonRoadVersion="2017a"/>', "CommonRoad version 2017a, expected 2018b or 2020a"),
        ('<commonRoad commonRoadVersion="2020a"/>', "without lanelets"),
        ('<commonRoad commonRoadVersion="2020a"><lanelet id="1"/></commonRoad>', "0 points on its left"),
        (lanelets().replace("<x>", "<x>a", 1), "no x and y"),
        ("[1, 2]", "JSON without tests"),
        ("{", "not JSON"),
        ('{"road_points": [[1, 2], [NaN, 3]]}', "expected finite metres"),
        ('{"interpolated_points": 3}', "expected a list of"),
        ("[" * 100_000, "not JSON"),
    ],
)
def test_what_cannot_be_a_road_gets_one_line(text: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text(text)
    with pytest.raises(RoadError, match=words) as problem:
        import_roads(path)
    assert str(problem.value).startswith(f"{path}: ") and "\n" not in str(problem.value)


def lanes(left: str, right: str) -> str:
    """A straight road of 100 m along y = 50 m with these lanes: `TYPE:WIDTH`, from the inside, or `TYPE|BORDER`."""

    def of(text: str, sign: int) -> str:
        tags = []
        for number, (kind, border, size) in enumerate((re.split(r"([:|])", one) for one in text.split()), 1):
            tag, value = ("border", sign * float(size)) if border == "|" else ("width", float(size))
            tags.append(LANE.format(sign * number, kind, tag, value, 0))
        return "".join(tags)

    return xodr(LINE, left=of(left, 1), right=of(right, -1))


@pytest.mark.parametrize(
    ("left", "right", "y", "width", "eastwards"),
    [
        ("driving:3.5", "driving:3.5", 50.0, 3.5, True),
        ("driving|3.25", "driving|3.25", 50.0, 3.25, True),
        ("median:1", "median:1 driving:3.5", 49.0, 3.5, True),
        ("", "median|1 driving|4.5", 49.0, 3.5, True),
        ("driving:3", "sidewalk:2", 50.0, 3.0, False),
        ("median:0.5 driving:3", "", 50.5, 3.0, False),
    ],
)
def test_the_innermost_driving_lane_is_driven(
    tmp_path: Path, left: str, right: str, y: float, width: float, eastwards: bool
) -> None:
    road = imported(lanes(left, right), tmp_path)
    assert road.points[:, 1] == pytest.approx(y) and (road.lane_width, road.lane) == (width, "right")
    assert bool(road.points[-1, 0] > road.points[0, 0]) is eastwards and road.length == pytest.approx(100.0)
    assert road.lane_centre[:, 1] == pytest.approx(y - width / 2 if eastwards else y + width / 2)


def test_a_file_with_a_footpath_gives_its_other_roads(tmp_path: Path) -> None:
    good, foot = lanes("driving:3.5", "driving:3.5"), lanes("", "sidewalk:2").replace('name="r"', 'name="foot"')
    path, second = tmp_path / "map.xodr", foot[foot.index("<road ") : foot.index("</OpenDRIVE>")]
    path.write_text(
        good.replace("</OpenDRIVE>", f"{second}</OpenDRIVE>").replace("<OpenDRIVE>", '<OpenDRIVE xmlns="x">')
    )
    left_out = LeftOut("roads")
    (found,) = import_roads(path, left_out)
    assert found.road.length == pytest.approx(100.0)
    assert left_out.line() == "1 of 2 roads left out: foot (it has no driving lane from 0 m on)"
    with pytest.raises(RoadError, match="road 'foot': it has no driving lane"):
        import_roads(path)


@pytest.mark.parametrize("shift", [(50.0, 0.005), (49.995, 0.0), (50.009, 0.0), (50.0, 0.0)])
def test_joints_may_have_the_gaps_that_asam_allows(tmp_path: Path, shift: tuple[float, float]) -> None:
    text = xodr((0, 50, 50, 0.0, 50, "<line/>"), (50, 50 + shift[0], 50 + shift[1], 0.0, 50, "<line/>"))
    road = imported(text, tmp_path)
    assert road.validity.valid and road.length == pytest.approx(100.0, abs=0.02) and road.curvature < 0.002


CIRCLE = np.array([(60 * math.cos(a), 60 * math.sin(a)) for a in np.arange(0.0, 2 * math.pi, 0.05)])


@pytest.mark.parametrize(
    ("header", "row", "width"),
    [
        ("", "{x},{y}", 4.0),
        ("", "{x}, {y}", 4.0),
        ("", "{x} {y}", 4.0),
        ("x;y", "{x};{y}", 4.0),
        ("x;y", "{x:.9f}|{y:.9f}", 4.0),
        ("# x_m, y_m, w_tr_right_m, w_tr_left_m", "{x}, {y}, 1.5, 1.5", 1.5),
        ("# 9ab3\n# s_m; x_m; y_m; psi_rad; vx_mps", "7; {x}; {y}; 0.5; 3.0", 4.0),
        ("time,y,x", "0.1,{y},{x}", 4.0),
        ("\ufeffX,Y", "{x},{y}", 4.0),
    ],
)
def test_tracks_are_read_whoever_wrote_them(tmp_path: Path, header: str, row: str, width: float) -> None:
    path = tmp_path / "track.csv"
    rows = [row.format(x=x, y=y) for x, y in CIRCLE.tolist()]
    rows = [line.replace(".", ",").replace("|", ";") if "|" in row else line for line in rows]
    path.write_text("\n".join([*([header] if header else []), *rows, ""]))
    (found,) = import_roads(path)
    assert found.name == "track" and found.road.lane_width == width
    assert found.road.points - np.array(found.moved) == pytest.approx(CIRCLE, abs=1e-9)
    (wide,) = import_roads(path, lane_width=3.0)
    assert wide.road.lane_width == 3.0


def test_the_line_lies_in_the_middle_of_its_track(tmp_path: Path) -> None:
    rows = "".join(f"{x},50,1,2\n" for x in range(0, 60, 2))
    (tmp_path / "t.csv").write_text("x_m,y_m,w_tr_right_m,w_tr_left_m\n" + rows)
    (found,) = import_roads(tmp_path / "t.csv")
    assert found.road.lane_width == 1.5 and found.road.points[:, 1] - found.moved[1] == pytest.approx(50.5)
    (single,) = import_roads(tmp_path / "t.csv", lane="single")  # the same borders
    assert (single.road.lane, single.road.lane_width) == ("single", 3.0)
    assert np.ptp([*single.road.left_edge[:, 1], *single.road.right_edge[:, 1]]) == pytest.approx(3.0)
    (cut,) = import_roads(tmp_path / "t.csv", lane="middle", sections=(40.0, 100.0))
    assert (cut.road.lane, cut.road.lane_width) == ("middle", 1.5)


def test_a_track_is_as_wide_as_in_its_narrowest_place(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Unlike that of a lane, a track's width may vary; its lanes fit everywhere then."""
    rows = "".join(f"{x},50,{3 + x % 3},{3 + x % 3}\n" for x in range(60))
    (tmp_path / "t.csv").write_text("# x_m,y_m,w_tr_right_m,w_tr_left_m\n" + rows)
    with caplog.at_level("INFO"):
        (found,) = import_roads(tmp_path / "t.csv")
    assert found.road.lane_width == 3.0
    assert "t: lanes of 3.00 to 5.00 m: they are as wide as in the narrowest place" in caplog.text
    (scaled,) = import_roads(tmp_path / "t.csv", scale=2.0)
    assert scaled.road.lane_width == 6.0 and scaled.road.length == pytest.approx(2.0 * found.road.length)


@pytest.mark.parametrize("repeat", [0.0, 0.001])
def test_a_closed_track_ends_before_its_start(tmp_path: Path, repeat: float) -> None:
    points = [*CIRCLE.tolist(), [60.0 + repeat, 0.0]]
    (tmp_path / "t.csv").write_text("".join(f"{x},{y}\n" for x, y in points))
    (found,) = import_roads(tmp_path / "t.csv")
    assert found.road.validity.valid and len(found.road.points) == len(CIRCLE)
    cut = import_roads(tmp_path / "t.csv", sections=(100.0, 90.0))
    assert [one.name for one in cut] == ["t_0", "t_90", "t_180", "t_270", "t_360"]
    assert {round(one.road.length, 6) for one in cut} == {100.0}


def test_the_second_of_three_columns_may_be_unitys_height(tmp_path: Path) -> None:
    (tmp_path / "t.txt").write_text("".join(f"{x},0.5,{y}\n" for x, y in CIRCLE.tolist()))
    (found,) = import_roads(tmp_path / "t.txt")
    assert found.road.points - np.array(found.moved) == pytest.approx(CIRCLE, abs=1e-9)


def test_a_pointer_of_git_lfs_is_called_that(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 7\n")
    with pytest.raises(RoadError, match="a pointer of Git LFS in the place of the file: fetch it with `git lfs pull`"):
        import_roads(tmp_path / "t.csv")


def test_a_track_that_is_too_large_is_cut(tmp_path: Path) -> None:
    """A circle of 400 m radius: sections of 200 m, each a fourteenth of a turn, over the end, too."""
    angles = np.linspace(0.0, 2 * math.pi, 2500, endpoint=False)
    (tmp_path / "ring.csv").write_text("".join(f"{400 * math.cos(a)},{400 * math.sin(a)}\n" for a in angles))
    (whole,) = import_roads(tmp_path / "ring.csv")
    assert not whole.road.validity.valid
    sections = import_roads(tmp_path / "ring.csv", sections=(200.0, 300.0))
    assert [one.name for one in sections] == [f"ring_{start}" for start in range(0, 2500, 300)]
    for one in sections:
        assert one.road.validity.valid and one.road.length == pytest.approx(200.0, abs=0.01)
        turned = np.diff(np.unwrap(np.arctan2(*np.diff(one.road.points, axis=0)[[0, -1], ::-1].T)))
        assert turned == pytest.approx(200.0 / 400.0, abs=0.01)
    (tmp_path / "open.csv").write_text("".join(f"{x},{x % 7}\n" for x in range(0, 250, 10)))
    assert len(import_roads(tmp_path / "open.csv", sections=(100.0, 50.0))) == 4
    with pytest.raises(RoadError, match="is 2.. m long, expected 900 m: cut shorter sections"):
        import_roads(tmp_path / "open.csv", sections=(900.0, 50.0))


def test_tests_of_the_sdc_competition_are_read(tmp_path: Path) -> None:
    points = [{"sequence_number": n, "x": 100.0 + 2 * n, "y": 50.0} for n in range(40)]
    roads = {"65aa": points[::-1], "65ab": [{"x": 1}]}
    tests = [{"_id": {"$oid": name}, "road_points": road} for name, road in roads.items()]
    (tmp_path / "sdc.json").write_text(json.dumps(tests))
    left_out = LeftOut("roads")
    (found,) = import_roads(tmp_path / "sdc.json", left_out)
    assert found.name == "65aa" and found.road.points[:, 0] == pytest.approx(np.arange(40) * 2 + 100.0)
    assert left_out.line().startswith("1 of 2 roads left out: 65ab (")


@pytest.fixture(scope="module")
def read_network(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Reads a road with pyxodr, whose drawing with matplotlib is not needed."""
    drawing = mock.MagicMock()
    drawing.text.Text = object
    stubs = {"matplotlib": drawing, "matplotlib.pyplot": drawing.pyplot}
    with mock.patch.dict(sys.modules, stubs):
        from pyxodr.road_objects.network import RoadNetwork

    def read(text: str) -> Any:
        path = tmp_path_factory.mktemp("xodr") / "road.xodr"
        path.write_text(text)
        network = RoadNetwork(str(path), resolution=0.05)
        (road,) = network.get_roads()
        return road

    return read


@pytest.mark.parametrize("name", WITH_LANES_ASIDE)
def test_opendrive_is_valid_by_asams_schema(name: str) -> None:
    etree = pytest.importorskip("lxml.etree")  # one of the libraries for `make test`
    checker = find_spec("qc_opendrive")  # not imported: the schemas alone are needed
    assert checker is not None and checker.submodule_search_locations
    folder = Path(checker.submodule_search_locations[0]) / "schema/1.7.0"
    schema = etree.XMLSchema(etree.parse(str(folder / "opendrive_17_core.xsd")))
    document = etree.fromstring(opendrive(ROADS[name], name).encode())
    schema.assertValid(document)
    pieces = document.findall(".//planView/geometry")
    # Without gaps: each piece begins where the last one ends.
    ends = np.cumsum([float(piece.get("length")) for piece in pieces])
    assert [float(piece.get("s")) for piece in pieces[1:]] == pytest.approx(list(ends[:-1]))
    assert float(document.find("road").get("length")) == pytest.approx(ends[-1])
    assert {lane.get("id") for lane in document.iter("lane")} == {"-1", "0", "1"}


@pytest.mark.parametrize("name", WITH_LANES_ASIDE)
def test_another_reader_finds_the_road_where_it_is(name: str, read_network: Any) -> None:
    road = ROADS[name]
    found = read_network(opendrive(road, name))
    line = shapely.LineString(found.reference_line[:, :2])
    distances = shapely.distance(line, shapely.points(road.points))
    assert distances.max() < 5e-3  # it samples every 5 cm, across kinks
    assert line.length == pytest.approx(road.length, rel=5e-3)
    assert np.hypot(*(found.reference_line[0, :2] - road.points[0])) < 1e-6
    (section,) = found.lane_sections
    borders = {lane.id: shapely.LineString(lane.boundary_line[:, :2]) for lane in section.lanes if lane.id}
    inner = slice(3, -3)  # at its samples our edge is across the next chord, not the tangent
    for lane, edge in ((1, road.left_edge), (-1, road.right_edge)):
        assert shapely.distance(borders[lane], shapely.points(edge[inner])).max() < 0.25


def test_files_are_named_after_the_roads_and_stay_in_their_folder(tmp_path: Path) -> None:
    paths = write_all([ROADS["random"]] * 2, ["../../x", "cell 3/17"], tmp_path / "out")
    assert [path.parent for path in paths] == [tmp_path / "out"] * 2 and all(path.is_file() for path in paths)
    with pytest.raises(RoadError, match="two roads are called"):
        write_all([ROADS["random"]] * 2, ["a/b", "a_b"], tmp_path / "out")
