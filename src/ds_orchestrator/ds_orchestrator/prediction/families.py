"""Families of tests: mutants descend from each other, so their outcomes are no independent evidence."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ds_road import Road
from ds_road.generation import GENES


def families_of(roads: Sequence[Road]) -> NDArray[np.intp]:
    """Number the families of tests by the root of mutation of their roads.

    Mutation moves the control points `GENES` alone (`ds_road.mutate`), or a condition. The others stay bit for bit
    those of the root, which differ between random roads: equal ones tell a family, and no pedigree need be stored.

    Args:
        roads: (tests,) roads.

    Returns:
        (tests,) numbers from 0, in the order of first appearance.
    """
    numbers: dict[object, int] = {}
    return np.array([numbers.setdefault(_kept_by_mutation(road), len(numbers)) for road in roads], np.intp)


def _kept_by_mutation(road: Road) -> object:
    if road.sampled:
        return road.road_id  # has no control points to move
    return road.lane, tuple(point for k, point in enumerate(road.control_points) if k not in GENES)
