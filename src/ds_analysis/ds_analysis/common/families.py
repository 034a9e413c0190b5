"""Families of tests: mutants descend from each other, so their outcomes are no independent evidence."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from ds_analysis.common.statistics import RESAMPLES, bootstrap_interval
from ds_road import Road
from ds_road.generation import GENES

Indices = NDArray[np.intp]


def families_of(roads: Sequence[Road]) -> Indices:
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


def are_alone(families: Indices) -> bool:
    """Whether every test is a family of its own, as random roads are."""
    return len(np.unique(families)) == len(families)


def parts_of(families: Indices, parts: int, seed: int) -> Indices:
    """Divide families at random into parts, or into as many as there are families; (tests,) number of the part."""
    known, member = np.unique(families, return_inverse=True)
    order = np.random.default_rng(seed).permutation(len(known))
    return np.asarray((order % min(parts, len(known)))[member])


def interval_over_families(
    samples: tuple[NDArray[np.float64], ...], statistic: Callable[..., float], families: Indices
) -> tuple[float, float] | None:
    """Estimate a 95 % interval by a bootstrap over whole families; see `bootstrap_interval`.

    Args:
        samples: (tests,) values each.
        statistic: of the samples.
        families: (tests,) number of the family.
    """
    if are_alone(families):
        return bootstrap_interval(samples, statistic, RESAMPLES)
    rows = [np.flatnonzero(families == one) for one in np.unique(families)]

    def of_families(drawn: NDArray[np.float64]) -> float:
        picked = np.concatenate([rows[int(k)] for k in drawn])
        return statistic(*(values[picked] for values in samples))

    return bootstrap_interval((np.arange(len(rows), dtype=np.float64),), of_families, RESAMPLES)


def _kept_by_mutation(road: Road) -> object:
    if road.sampled:
        return road.road_id  # has no control points to move
    return road.lane, tuple(point for k, point in enumerate(road.control_points) if k not in GENES)
