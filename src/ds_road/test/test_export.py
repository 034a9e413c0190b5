# SPDX-License-Identifier: Apache-2.0
"""Exported roads against independent readers: ASAM's schema, an OpenDRIVE library, and this project's own reader."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
import shapely

from ds_road import Road, RoadError, generate
from ds_road.export import opendrive, write_all

etree = pytest.importorskip("lxml.etree")  # one of the libraries for `make test`
ROADS = {
    "random": generate(np.random.default_rng(3)),
    "tight": generate(np.random.default_rng(8), max_angle=300),
    "straight": Road([(125.0, 25.0 * i) for i in range(9)]),
    "maxitwo": Road(generate(np.random.default_rng(5)).control_points, maxitwo_compatible=True),
    "sampled": Road.from_road_points(generate(np.random.default_rng(7)).points, lane_width=3.0),
    "left": generate(np.random.default_rng(9), lane="left"),
}


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


@pytest.mark.parametrize("name", ROADS)
def test_opendrive_is_valid_by_asams_schema(name: str) -> None:
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


@pytest.mark.parametrize("name", ROADS)
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
