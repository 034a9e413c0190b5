# SPDX-License-Identifier: Apache-2.0
"""Roads: spline, lanes, validity, generation, mutation, features, JSON."""

from ds_road.files import (
    check,
    parse_roads,
    read_raw_roads,
    read_roads,
    road_from_fields,
    road_from_json,
    road_to_json,
    write_roads,
)
from ds_road.generation import MutationError, generate, mutate
from ds_road.geometry import Validity
from ds_road.picture import draw
from ds_road.road import LANE_WIDTH, Road, RoadError, Side

__all__ = [
    "LANE_WIDTH",
    "MutationError",
    "Road",
    "RoadError",
    "Side",
    "Validity",
    "check",
    "draw",
    "generate",
    "mutate",
    "parse_roads",
    "read_raw_roads",
    "read_roads",
    "road_from_fields",
    "road_from_json",
    "road_to_json",
    "write_roads",
]
