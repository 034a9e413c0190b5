"""Roads against the values that the authors' package computes for 200 roads."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ds_road import Road

ROADS: list[dict[str, Any]] = json.loads((Path(__file__).parent / "data" / "roads.json").read_text())["roads"]


def test_there_are_200_roads_of_three_kinds() -> None:
    kinds = [road["kind"] for road in ROADS]
    assert (kinds.count("generated"), kinds.count("mutated"), kinds.count("scrambled")) == (70, 70, 60)


@pytest.mark.parametrize("vector", ROADS, ids=range(len(ROADS)))
def test_road_equals_the_published_one(vector: dict[str, Any]) -> None:
    """Points to a micrometre, curvature to 1e-9, turns and validity exactly, for scrambled roads too.

    No scrambled road differs: all 60 fold an edge or leave the box, under the authors' rule (which bounds the control
    points) and under ours (which bounds the edges) alike.
    """
    road = Road(vector["control_points"])
    np.testing.assert_allclose(road.points, vector["road_points"], rtol=0, atol=1e-6)
    assert road.curvature == pytest.approx(vector["curvature"], rel=1e-9)
    assert road.turns_count == vector["turns_count"]
    assert road.turns_count_published == vector["turns_count_published"]
    assert road.validity.valid == vector["valid"], road.validity.reason
    assert bool(road.validity.reason) == (not road.validity.valid)
