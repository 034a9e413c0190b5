"""Pool, unite and merge feature maps (paper 3.3 to 3.5)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

from ds_orchestrator.maps.feature_map import FeatureMap, MapCell
from ds_orchestrator.maps.map_id import MapId
from ds_orchestrator.maps.merge_operators import apply, jeffreys_interval, merged_interval
from ds_orchestrator.search.features import DEFAULT_FEATURES, Cell
from ds_orchestrator.store.model import Execution


def pool(
    map_id: MapId,
    runs: Iterable[tuple[Cell, Execution]],
    normalise: Normalise,
    *,
    features: tuple[str, ...] = DEFAULT_FEATURES,
) -> FeatureMap:
    """Pool executions by cell; pooling several search runs gives their combined map (paper 3.3).

    Args:
        map_id: identity of the map.
        runs: cell and execution of each test.
        normalise: scales maximum lateral positions to [0, 1].
        features: names of the axes.
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
        map_id: identity of the union.
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
        probability: operator of the failure probabilities; see `ds_orchestrator.maps.merge_operators`.
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
    axes = {m.features for m in maps}
    if len(axes) > 1:
        raise ValueError(f"maps of different features to {what}: {' and '.join(map(str, sorted(axes)))}")


Normalise = Callable[[float], float]
"""Scales a maximum lateral position, m, to [0, 1] over the campaign."""
