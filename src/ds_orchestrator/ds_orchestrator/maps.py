"""Feature maps: tests pooled per cell, united over their origins, merged over siblings (paper 3.3 to 3.5)."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

from ds_orchestrator.features import DEFAULT_FEATURES, Cell, cell_of, feature_of
from ds_orchestrator.operators import apply, jeffreys_interval, merged_interval
from ds_orchestrator.search import Archive
from ds_orchestrator.store import Execution, Test


@dataclass(frozen=True, kw_only=True)
class MapCell:
    """One filled cell of a feature map; a cell without tests is not there at all, which is not the same as 0.

    Attributes:
        tests: tests pooled in it; in a merged map, those of the sibling with the fewest.
        failures: how many of them failed; None in a merged map, whose probability is made of the siblings'.
        probability: of failure, in [0, 1].
        quality: lack of driving quality, in [0, 1]: mean of the tests' maximum lateral positions, normalised over
            the campaign (paper 4.2.5); in a union the mean of its maps' values (paper 3.4); the higher the worse.
        pooled_quality: the same as the mean over all tests of the cell, as in maxitwo; None where it is not known.
        interval: 95 % interval of the probability, or None where the counts behind it are not known.
    """

    tests: int
    failures: int | None
    probability: float
    quality: float
    pooled_quality: float | None = None
    interval: tuple[float, float] | None = None


@dataclass(frozen=True, kw_only=True)
class FeatureMap:
    """Cells by one bin per feature.

    Attributes:
        name: tells what it is a map of.
        cells: filled cells.
        features: names of the axes; see `ds_orchestrator.features`.
    """

    name: str
    cells: Mapping[Cell, MapCell]
    features: tuple[str, ...] = DEFAULT_FEATURES


@dataclass(frozen=True, kw_only=True)
class MapPlan:
    """How a campaign's maps are made.

    Attributes:
        features: names of the axes.
        elites_only: migrate, unite and compare the elites of each run alone, not every test.
        published: as in maxitwo: a search's map holds its elites alone, turns are counted with its constants, and the
            quality of a union is the mean over the pooled tests.
        probability: operator that merges failure probabilities.
        quality: operator that merges lack of quality.
        others: further operators, each of which makes a map of its own, of both values.
        ignored: tests without whose outcome their search went on, even if they have one by now.
    """

    features: tuple[str, ...] = DEFAULT_FEATURES
    elites_only: bool = False
    published: bool = False
    probability: str = "product"
    quality: str = "minimum"
    others: tuple[str, ...] = ()
    ignored: frozenset[str] = frozenset()


Normalise = Callable[[float], float]
"""From a maximum lateral position in m to [0, 1] over the campaign."""


def normaliser(executions: Iterable[Execution]) -> Normalise:
    """Scale maximum lateral positions to [0, 1] by their range over every simulator of the campaign (paper 4.2.5)."""
    values = [execution.max_lateral_position for execution in executions]
    low, high = min(values, default=0.0), max(values, default=0.0)
    if high == low:
        return lambda value: 0.0
    return lambda value: (value - low) / (high - low)


def cells_of(
    tests: Iterable[Test],
    executions: Iterable[Execution],
    *,
    features: Sequence[str] = DEFAULT_FEATURES,
    published: bool = False,
) -> dict[str, Cell]:
    """Cell by test, of every test that has one; see `ds_orchestrator.features`."""
    at_home = {(e.test_id, e.simulator): e for e in executions if e.outcome.is_verdict}
    cells = {}
    for test in tests:
        cell = cell_of(test.road, at_home.get((test.test_id, test.sibling)), features=features, published=published)
        if cell is not None:
            cells[test.test_id] = cell
    return cells


def elites_of(
    tests: Iterable[Test],
    executions: Iterable[Execution],
    cells: Mapping[str, Cell],
    *,
    ignored: Collection[str] = (),
) -> set[str]:
    """The tests that each run of a search ends with: the elite of each of its cells."""
    at_home = {(e.test_id, e.simulator): e for e in executions if e.outcome.is_verdict}
    archives: dict[tuple[str, int], Archive] = {}
    elites: dict[tuple[str, int], dict[Cell, str]] = {}
    for test in sorted(tests, key=lambda t: (t.sibling, t.run, t.number)):
        execution = at_home.get((test.test_id, test.sibling))
        if execution is None or test.test_id in ignored or test.test_id not in cells:
            continue
        run, cell = (test.sibling, test.run), cells[test.test_id]
        archive = archives.setdefault(run, Archive())
        if archive.place(cell, test.road, execution.fitness, failed=execution.outcome.is_failure):
            elites.setdefault(run, {})[cell] = test.test_id
    return {test_id for of_run in elites.values() for test_id in of_run.values()}


def pool(
    name: str,
    runs: Iterable[tuple[Cell, Execution]],
    normalise: Normalise,
    *,
    features: tuple[str, ...] = DEFAULT_FEATURES,
) -> FeatureMap:
    """Place every executed test in its cell; of several runs of a search this is their combined map (paper 3.3)."""
    groups: dict[Cell, list[Execution]] = {}
    for cell, execution in runs:
        groups.setdefault(cell, []).append(execution)
    cells = {}
    for cell in sorted(groups):
        group = groups[cell]
        failures = sum(e.outcome.is_failure for e in group)
        quality = math.fsum(normalise(e.max_lateral_position) for e in group) / len(group)
        cells[cell] = MapCell(
            tests=len(group),
            failures=failures,
            probability=failures / len(group),
            quality=quality,
            pooled_quality=quality,
            interval=jeffreys_interval(failures, len(group)),
        )
    return FeatureMap(name=name, cells=cells, features=features)


def union(name: str, maps: Sequence[FeatureMap], *, pooled_quality: bool = False) -> FeatureMap:
    """Unite maps of different tests on the same simulator (paper 3.4).

    Failures and tests are summed over the maps. Quality is the mean of the maps' values, so that a map of one test
    counts like one of ten; a map that leaves the cell empty says nothing and does not count as 0.

    Args:
        name: of the union.
        maps: whose cells hold counted tests, at least one.
        pooled_quality: take the mean over all tests instead, as maxitwo does.

    Raises:
        ValueError: no maps, or one without counts.
    """
    _check_axes(maps, "unite")
    cells = {}
    for cell in sorted(set().union(*(m.cells for m in maps))):
        parts = [m.cells[cell] for m in maps if cell in m.cells]
        if any(p.failures is None for p in parts):
            raise ValueError(f"a map of {name} has no counts: expected maps of tests, not merged ones")
        tests, failures = sum(p.tests for p in parts), sum(p.failures or 0 for p in parts)
        pooled = math.fsum(p.tests * (p.quality if p.pooled_quality is None else p.pooled_quality) for p in parts)
        of_maps = math.fsum(p.quality for p in parts) / len(parts)
        cells[cell] = MapCell(
            tests=tests,
            failures=failures,
            probability=failures / tests,
            quality=pooled / tests if pooled_quality else of_maps,
            pooled_quality=pooled / tests,
            interval=jeffreys_interval(failures, tests),
        )
    return FeatureMap(name=name, cells=cells, features=maps[0].features)


def merge(
    name: str, maps: Sequence[FeatureMap], *, probability: str = "product", quality: str = "minimum"
) -> FeatureMap:
    """Merge the union maps of all siblings: only agreement counts (paper 3.5).

    A cell that one of the maps leaves empty is empty: nobody knows whether that sibling agrees. One sibling gives its
    own map back.

    Args:
        name: of the merged map.
        maps: one per sibling, in any order.
        probability: operator of the failure probabilities; see `ds_orchestrator.operators`.
        quality: operator of the lack of quality.

    Raises:
        ValueError: no maps.
    """
    _check_axes(maps, "merge")
    if len(maps) == 1:
        return FeatureMap(name=name, cells=dict(maps[0].cells), features=maps[0].features)
    cells = {}
    for cell in sorted(set(maps[0].cells).intersection(*(m.cells for m in maps[1:]))):
        parts = [m.cells[cell] for m in maps]
        tests = [p.tests for p in parts]
        counts = [(p.failures, p.tests) for p in parts if p.failures is not None]
        pooled = [p.pooled_quality for p in parts if p.pooled_quality is not None]
        cells[cell] = MapCell(
            tests=min(tests),
            failures=None,
            probability=apply(probability, [p.probability for p in parts], tests),
            quality=apply(quality, [p.quality for p in parts], tests),
            pooled_quality=apply(quality, pooled, tests) if len(pooled) == len(parts) else None,
            interval=merged_interval(probability, counts) if len(counts) == len(parts) else None,
        )
    return FeatureMap(name=name, cells=cells, features=maps[0].features)


def _check_axes(maps: Sequence[FeatureMap], what: str) -> None:
    if not maps:
        raise ValueError(f"no maps to {what}: expected at least one")
    axes = {m.features for m in maps}
    if len(axes) > 1:
        raise ValueError(f"maps of different features to {what}: {' and '.join(map(str, sorted(axes)))}")


def campaign_maps(
    siblings: Sequence[str],
    twin: str | None,
    tests: Sequence[Test],
    executions: Sequence[Execution],
    plan: MapPlan = MapPlan(),  # noqa: B008 (immutable)
) -> dict[str, FeatureMap]:
    """Every map of a campaign by name.

    `search_<i>` holds the tests of sibling i on itself, `migration_<i>_to_<j>` those of i on j (another sibling, or the
    twin), `union_<i>` all tests on i, `merged` their merge, `merged_<operator>` the same with another operator, and
    `twin_<name>` all tests on the twin. Executions without a verdict enter no map, nor do tests without a cell.
    """
    verdicts = [e for e in executions if e.outcome.is_verdict]
    cells = cells_of(tests, verdicts, features=plan.features, published=plan.published)
    everything = set(cells)
    migrated = elites_of(tests, verdicts, cells, ignored=plan.ignored) if plan.elites_only else everything
    searched = migrated if plan.published else everything
    used = [e for e in verdicts if e.test_id in searched]
    normalise = normaliser(used)
    done = {(e.test_id, e.simulator): e for e in used}

    def on(name: str, simulator: str, origin: str, chosen: set[str]) -> FeatureMap:
        mine = (t.test_id for t in tests if t.sibling == origin and t.test_id in chosen)
        pairs = [(cells[i], done[i, simulator]) for i in mine if (i, simulator) in done]
        return pool(name, pairs, normalise, features=plan.features)

    maps = {}
    for sibling in siblings:
        maps[f"search_{sibling}"] = on(f"search_{sibling}", sibling, sibling, searched)
    for origin in siblings:
        for target in [*siblings, *([twin] if twin else [])]:
            if target != origin:
                name = f"migration_{origin}_to_{target}"
                maps[name] = on(name, target, origin, migrated)
    for sibling in siblings:
        own = on(f"search_{sibling}", sibling, sibling, migrated)
        parts = [own, *(maps[f"migration_{other}_to_{sibling}"] for other in siblings if other != sibling)]
        maps[f"union_{sibling}"] = union(f"union_{sibling}", parts, pooled_quality=plan.published)
    unions = [maps[f"union_{sibling}"] for sibling in siblings]
    maps["merged"] = merge("merged", unions, probability=plan.probability, quality=plan.quality)
    for operator in plan.others:
        name = f"merged_{operator}"
        maps[name] = merge(name, unions, probability=operator, quality=operator)
    if twin:
        parts = [maps[f"migration_{origin}_to_{twin}"] for origin in siblings]
        maps[f"twin_{twin}"] = union(f"twin_{twin}", parts, pooled_quality=plan.published)
    return maps


def slices_of(feature_map: FeatureMap) -> list[FeatureMap]:
    """A map of three features as maps of its first two, one per value of the third; any other map as it is."""
    if len(feature_map.features) < 3:
        return [feature_map]
    first, second, third = feature_map.features
    of_third = feature_of(third)
    values = sorted({cell[2] for cell in feature_map.cells})
    if not values:
        return [FeatureMap(name=feature_map.name, cells={}, features=(first, second))]
    return [
        FeatureMap(
            name=f"{feature_map.name}, {of_third.title} {of_third.label(value)}",
            cells={cell[:2]: content for cell, content in feature_map.cells.items() if cell[2] == value},
            features=(first, second),
        )
        for value in values
    ]


def to_json(maps: Mapping[str, FeatureMap]) -> dict[str, object]:
    """Maps as plain JSON values; the same maps give the same text."""
    return {
        name: {
            "features": list(feature_map.features),
            "cells": [
                {
                    **dict(zip(feature_map.features, cell, strict=True)),
                    "tests": value.tests,
                    "failures": value.failures,
                    "probability": value.probability,
                    "interval": None if value.interval is None else list(value.interval),
                    "quality": value.quality,
                    "pooled_quality": value.pooled_quality,
                }
                for cell, value in sorted(feature_map.cells.items())
            ],
        }
        for name, feature_map in maps.items()
    }
