# SPDX-License-Identifier: Apache-2.0
"""Builds every map of a campaign from its tests and executions (paper 3.3 to 3.5)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

from ds_orchestrator.maps.algebra import Normalise, merge, pool, union
from ds_orchestrator.maps.feature_map import FeatureMap, MapId, map_ids
from ds_orchestrator.search.algorithms import Archive
from ds_orchestrator.search.features import DEFAULT_FEATURES, Cell, cell_of, feature_of
from ds_orchestrator.store.model import Execution, Test
from ds_sim.gates.gate import Gate
from ds_sim.registry import SimulatorName


@dataclass(frozen=True, kw_only=True)
class MapPlan:
    """Parameters of a campaign's maps.

    Attributes:
        features: names of the axes.
        elites_only: migrate, unite and compare only the elites of each run, not every test.
        maxitwo_compatible: as in maxitwo: a search's map holds only its elites, turns are counted with its constants,
            and the quality loss of a union is the mean over the pooled tests.
        probability: operator that merges failure probabilities.
        quality_loss: operator that merges quality losses.
        others: further operators, each of which makes a further merged map, of both values.
        ignored: tests whose search continued without their outcome, even if they have one now.
    """

    features: tuple[str, ...] = DEFAULT_FEATURES
    elites_only: bool = False
    maxitwo_compatible: bool = False
    probability: str = "product"
    quality_loss: str = "minimum"
    others: tuple[str, ...] = ()
    ignored: frozenset[str] = frozenset()


def normaliser(executions: Iterable[Execution]) -> Normalise:
    """Create a function that scales maximum lateral positions to [0, 1] by their range over all simulators (4.2.5)."""
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
    maxitwo_compatible: bool = False,
    gates: Mapping[tuple[str, SimulatorName], Gate] = MappingProxyType({}),
) -> dict[str, Cell]:
    """Map test -> cell, for every test that has one; see `cell_of`. Gates have the measured contrast of lines."""
    verdicts = {(e.test_id, e.simulator): e for e in executions if e.outcome.is_verdict}
    cells = {}
    for test in tests:
        own = test.test_id, test.sibling
        cell = cell_of_test(test, verdicts.get(own), gates.get(own), features, maxitwo_compatible=maxitwo_compatible)
        if cell is not None:
            cells[test.test_id] = cell
    return cells


def cell_of_test(
    test: Test, own: Execution | None, gate: Gate | None, features: Sequence[str], *, maxitwo_compatible: bool
) -> Cell | None:
    """Compute the cell of a test, given its execution and its gate on the sibling whose search generated it."""
    return cell_of(
        test.road,
        own,
        features=features,
        maxitwo_compatible=maxitwo_compatible,
        conditions=test.conditions,
        visible_contrast=None if gate is None or gate.outcome is None else gate.visible_contrast,
    )


def elites_of(
    tests: Iterable[Test], executions: Iterable[Execution], cells: Mapping[str, Cell], *, ignored: Collection[str] = ()
) -> set[str]:
    """Find the tests that are elites at the end of each search run; searches went on without the `ignored` ones."""
    verdicts = {(e.test_id, e.simulator): e for e in executions if e.outcome.is_verdict}
    archives: dict[tuple[str, int], Archive] = {}
    elites: dict[tuple[str, int], dict[Cell, str]] = {}
    for test in sorted(tests, key=lambda t: (t.sibling, t.run, t.number)):
        execution = verdicts.get((test.test_id, test.sibling))
        if execution is None or test.test_id in ignored or test.test_id not in cells:
            continue
        run, cell = (test.sibling, test.run), cells[test.test_id]
        archive = archives.setdefault(run, Archive())
        if archive.place(cell, test.scenario, execution.fitness, failed=execution.outcome.is_failure):
            elites.setdefault(run, {})[cell] = test.test_id
    return {test_id for of_run in elites.values() for test_id in of_run.values()}


def build_maps(
    siblings: Sequence[SimulatorName],
    twin: SimulatorName | None,
    tests: Sequence[Test],
    executions: Sequence[Execution],
    plan: MapPlan = MapPlan(),  # noqa: B008 (immutable)
    *,
    gates: Mapping[tuple[str, SimulatorName], Gate] = MappingProxyType({}),
) -> dict[MapId, FeatureMap]:
    """Build every map of a campaign; see `MapId` for the kinds.

    Executions without a verdict and tests without a cell enter no map. Tests that gates exclude are counted apart.
    """
    verdicts = [e for e in executions if e.outcome.is_verdict]
    cells = cells_of(tests, verdicts, features=plan.features, maxitwo_compatible=plan.maxitwo_compatible, gates=gates)
    axes, everything = tuple(map(feature_of, plan.features)), set(cells)
    migrated = elites_of(tests, verdicts, cells, ignored=plan.ignored) if plan.elites_only else everything
    searched = migrated if plan.maxitwo_compatible else everything
    used = [e for e in verdicts if e.test_id in searched]
    normalise = normaliser(used)
    done = {(e.test_id, e.simulator): e for e in used}

    def on(map_id: MapId, chosen: set[str]) -> FeatureMap:
        tests_of_origin = (t.test_id for t in tests if t.sibling == map_id.origin and t.test_id in chosen)
        pairs = [(cells[i], done[i, map_id.simulator]) for i in tests_of_origin if (i, map_id.simulator) in done]
        return pool(map_id, pairs, normalise, features=axes)

    pooled = plan.maxitwo_compatible
    maps: dict[MapId, FeatureMap] = {}
    for map_id in map_ids(siblings, twin, plan.others):
        if map_id.kind in ("search", "migration"):
            maps[map_id] = on(map_id, searched if map_id.kind == "search" else migrated)
        elif map_id.kind == "union":
            own = on(MapId.search(map_id.simulator), migrated)
            others = [maps[MapId.migration(o, map_id.simulator)] for o in siblings if o != map_id.simulator]
            maps[map_id] = union(map_id, [own, *others], pooled_quality_loss=pooled)
        elif map_id.kind == "merged":
            probability, quality_loss = (map_id.operator or o for o in (plan.probability, plan.quality_loss))
            unions = [maps[MapId.union(sibling)] for sibling in siblings]
            maps[map_id] = merge(map_id, unions, probability=probability, quality_loss=quality_loss)
        else:
            parts = [maps[MapId.migration(origin, map_id.simulator)] for origin in siblings]
            maps[map_id] = union(map_id, parts, pooled_quality_loss=pooled)
    without = {key for key, gate in gates.items() if not gate.is_valid}
    if not without:
        return maps
    return {
        map_id: replace(feature_map, excluded=_excluded(map_id, siblings, tests, cells, migrated, without))
        for map_id, feature_map in maps.items()
    }


def _excluded(
    map_id: MapId,
    siblings: Sequence[SimulatorName],
    tests: Sequence[Test],
    cells: Mapping[str, Cell],
    migrated: Collection[str],
    without: Collection[tuple[str, str]],
) -> dict[Cell, int]:
    """Count the tests of a map that the gates exclude on its simulator, by cell; in a merged map, on any sibling."""
    counts: Counter[Cell] = Counter()
    for test in tests:
        on = siblings if map_id.kind == "merged" else [map_id.simulator]
        driven = [name for name in on if name == test.sibling or test.test_id in migrated]
        in_map = map_id.kind not in ("search", "migration") or test.sibling == map_id.origin
        if in_map and test.test_id in cells and any((test.test_id, name) in without for name in driven):
            counts[cells[test.test_id]] += 1
    return dict(sorted(counts.items()))
