# SPDX-License-Identifier: Apache-2.0
"""Pools, unites and merges feature maps (paper 3.3 to 3.5); the merge operators, and intervals of the result."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ds_base.extension import ExtensionError, installed, is_extension, load_extension, load_installed
from ds_base.intervals import LEVEL, PRIOR, jeffreys_interval
from ds_orchestrator.maps.feature_map import FeatureMap, MapCell, MapId
from ds_orchestrator.search.features import DEFAULT_AXES, Cell, Feature
from ds_orchestrator.store.model import Execution

DRAWS = 20_000
"""Draws from the posterior; chosen: ends of an interval are accurate to about 0.005, in 1 ms."""
Values = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class MergeOperator:
    """Rule that merges several siblings' values of a cell into one.

    Attributes:
        combine: computes values (...) from values (siblings, ...) and weights (siblings,), the numbers of tests.
        seed: seed of the draws of `merged_interval`; a constant of the operator, so that adding or reordering
            operators changes no interval.
    """

    combine: Callable[[Values, Values], Values]
    seed: int


OPERATORS: Mapping[str, MergeOperator] = {
    "product": MergeOperator(combine=lambda values, _: np.asarray(np.prod(values, axis=0)), seed=0),
    "minimum": MergeOperator(combine=lambda values, _: np.asarray(np.min(values, axis=0)), seed=1),
    "maximum": MergeOperator(combine=lambda values, _: np.asarray(np.max(values, axis=0)), seed=2),
    "mean": MergeOperator(combine=lambda values, _: np.asarray(np.mean(values, axis=0)), seed=3),
    "weighted_mean": MergeOperator(combine=lambda values, w: np.asarray(np.average(values, 0, w)), seed=4),
}
"""Operators by their name in a configuration. A new operator needs a seed that no other has.

Paper 3.5: the `product` of failure probabilities is high only where all siblings fail often, the `minimum` quality loss
only where every sibling drives badly; for the `maximum` one sibling suffices. The `mean` is the default of the authors'
package, and the mean weighted by numbers of tests an option of it; both are equal if all siblings ran all tests.
"""


def operator_of(name: str) -> MergeOperator:
    """Look up a merge operator; ExtensionError if the name is unknown, or leads to none.

    The name is a key of `OPERATORS`, an entry point of an installed package in the group `digital_siblings.operators`,
    or `module:NAME`, a `MergeOperator`.
    """
    if name in OPERATORS:
        return OPERATORS[name]
    if name in (others := installed("operators")):
        return load_installed(name, "operators", MergeOperator, "operator")
    if is_extension(name):
        return load_extension(name, MergeOperator, "operator")
    raise ExtensionError(
        f"unknown operator {name!r}: expected one of {', '.join((*OPERATORS, *others))}, or module:NAME"
    )


def apply(operator: str, values: Sequence[float], tests: Sequence[int]) -> float:
    """Merge several siblings' values, given their numbers of tests; the order of the siblings does not matter.

    Examples:
        >>> from ds_orchestrator.maps.algebra import apply
        >>> apply("product", values=[0.5, 0.2], tests=[4, 10]), apply("maximum", [0.5, 0.2], [4, 10])
        (0.1, 0.5)
    """
    pairs = np.array(sorted(zip(values, tests, strict=True)), np.float64)
    return float(operator_of(operator).combine(pairs[:, 0], pairs[:, 1]))


def merged_interval(operator: str, counts: Sequence[tuple[int, int]]) -> tuple[float, float]:
    """Estimate a 95% interval of a merged probability from the siblings' posteriors, not from their intervals' ends.

    Args:
        operator: name of the merge operator.
        counts: failures and tests of every sibling; their order does not matter.

    Returns:
        Equal tails of the operator's values over independent draws from the siblings' posteriors; if the merged share
        is exactly 0 or 1, so is that end, as in `jeffreys_interval`. Equal counts give equal intervals.

    Examples:
        >>> from ds_orchestrator.maps.algebra import merged_interval
        >>> [round(end, 1) for end in merged_interval("product", [(5, 10), (2, 10)])]
        [0.0, 0.3]
    """
    if len(counts) == 1:
        return jeffreys_interval(*counts[0])
    return _merged_interval(operator, tuple(sorted(counts)))


@lru_cache(maxsize=4096)
def _merged_interval(operator: str, counts: tuple[tuple[int, int], ...]) -> tuple[float, float]:
    merge = operator_of(operator)
    failures, tests = np.array(counts, np.float64).T
    rng = np.random.default_rng([merge.seed, *(n for pair in counts for n in pair)])
    draws = rng.beta((failures + PRIOR)[:, None], (tests - failures + PRIOR)[:, None], (len(counts), DRAWS))
    tail = (1.0 - LEVEL) / 2.0
    low, high = np.quantile(merge.combine(draws, tests), [tail, 1.0 - tail])
    merged = float(merge.combine(failures / tests, tests))
    return (0.0 if merged == 0.0 else float(low), 1.0 if merged == 1.0 else float(high))


def pool(
    map_id: MapId,
    runs: Iterable[tuple[Cell, Execution]],
    normalise: Normalise,
    *,
    features: tuple[Feature, ...] = DEFAULT_AXES,
) -> FeatureMap:
    """Pool executions by cell; pooling several search runs gives their combined map (paper 3.3).

    `normalise` scales maximum lateral positions to [0, 1].
    """
    groups: dict[Cell, list[Execution]] = {}
    for cell, execution in runs:
        groups.setdefault(cell, []).append(execution)
    cells = {}
    for cell in sorted(groups):
        group = groups[cell]
        failures = sum(e.outcome.is_failure for e in group)
        quality_loss = math.fsum(normalise(e.max_lateral_position) for e in group) / len(group)
        cells[cell] = MapCell(
            tests=len(group),
            failures=failures,
            probability=failures / len(group),
            quality_loss=quality_loss,
            pooled_quality_loss=quality_loss,
            interval=jeffreys_interval(failures, len(group)),
        )
    return FeatureMap(id=map_id, cells=cells, features=features)


def union(map_id: MapId, maps: Sequence[FeatureMap], *, pooled_quality_loss: bool = False) -> FeatureMap:
    """Unite maps of different tests on the same simulator (paper 3.4).

    Failures and tests are summed over the maps. Quality loss is the mean of the maps' values, so that a map with one
    test weighs as much as a map with ten; a map in which the cell is empty is left out of the mean.

    Args:
        map_id: of the union.
        maps: at least one, whose cells have counts of failures.
        pooled_quality_loss: take the mean over all tests instead, as maxitwo does.

    Raises:
        ValueError: no maps, or one without counts.

    Examples:
        >>> from ds_orchestrator import FeatureMap, MapCell, MapId, union
        >>> def tests(failures):
        ...     cell = MapCell(tests=4, failures=failures, probability=failures / 4, quality_loss=0.5)
        ...     return FeatureMap(id=MapId.search("bullet"), cells={(2, 17): cell})
        >>> united = union(MapId.union("bullet"), [tests(1), tests(3)])
        >>> united.cells[2, 17].tests, united.cells[2, 17].probability
        (8, 0.5)
    """
    _check_axes(maps, "unite")
    cells = {}
    for cell in sorted(set().union(*(m.cells for m in maps))):
        parts = [m.cells[cell] for m in maps if cell in m.cells]
        if any(p.failures is None for p in parts):
            raise ValueError(f"a map of {map_id.name} has no counts: expected maps of tests, not merged ones")
        tests, failures = sum(p.tests for p in parts), sum(p.failures or 0 for p in parts)
        pooled = math.fsum(
            p.tests * (p.quality_loss if p.pooled_quality_loss is None else p.pooled_quality_loss) for p in parts
        )
        of_maps = math.fsum(p.quality_loss for p in parts) / len(parts)
        cells[cell] = MapCell(
            tests=tests,
            failures=failures,
            probability=failures / tests,
            quality_loss=pooled / tests if pooled_quality_loss else of_maps,
            pooled_quality_loss=pooled / tests,
            interval=jeffreys_interval(failures, tests),
        )
    return FeatureMap(id=map_id, cells=cells, features=maps[0].features)


def merge(
    map_id: MapId, maps: Sequence[FeatureMap], *, probability: str = "product", quality_loss: str = "minimum"
) -> FeatureMap:
    """Merge the union maps of all siblings, keeping cells on which they agree (paper 3.5).

    A cell that is empty in one of the maps is empty in the result, since that sibling may disagree. A single map is
    returned unchanged.

    Args:
        map_id: identity of the merged map.
        maps: one per sibling, in any order.
        probability: operator of the failure probabilities; see `ds_orchestrator.maps.algebra`.
        quality_loss: operator of the quality losses.

    Raises:
        ValueError: no maps.

    Examples:
        >>> from ds_orchestrator import FeatureMap, MapCell, MapId, merge
        >>> def failing(share, sibling):
        ...     cell = MapCell(tests=4, failures=int(4 * share), probability=share, quality_loss=share)
        ...     return FeatureMap(id=MapId.union(sibling), cells={(2, 17): cell})
        >>> merged = merge(MapId.merged(), [failing(0.5, "bullet"), failing(0.25, "softbody")])
        >>> merged.cells[2, 17].probability, merged.cells[2, 17].quality_loss
        (0.125, 0.25)
    """
    _check_axes(maps, "merge")
    if len(maps) == 1:
        return FeatureMap(id=map_id, cells=dict(maps[0].cells), features=maps[0].features)
    cells = {}
    for cell in sorted(set(maps[0].cells).intersection(*(m.cells for m in maps[1:]))):
        parts = [m.cells[cell] for m in maps]
        tests = [p.tests for p in parts]
        counts = [(p.failures, p.tests) for p in parts if p.failures is not None]
        pooled = [p.pooled_quality_loss for p in parts if p.pooled_quality_loss is not None]
        cells[cell] = MapCell(
            tests=min(tests),
            failures=None,
            probability=apply(probability, [p.probability for p in parts], tests),
            quality_loss=apply(quality_loss, [p.quality_loss for p in parts], tests),
            pooled_quality_loss=apply(quality_loss, pooled, tests) if len(pooled) == len(parts) else None,
            interval=merged_interval(probability, counts) if len(counts) == len(parts) else None,
        )
    return FeatureMap(id=map_id, cells=cells, features=maps[0].features)


def _check_axes(maps: Sequence[FeatureMap], what: str) -> None:
    if not maps:
        raise ValueError(f"no maps to {what}: expected at least one")
    axes = {tuple(feature.axis for feature in m.features) for m in maps}
    if len(axes) > 1:
        raise ValueError(f"maps of different features to {what}: {' and '.join(map(str, sorted(axes)))}")


Normalise = Callable[[float], float]
"""Scales a maximum lateral position, m, to [0, 1] over the campaign."""
