"""Every map of a campaign, made of its tests and executions (paper 3.3 to 3.5)."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

from ds_orchestrator.maps.algebra import Normalise, merge, pool, union
from ds_orchestrator.maps.feature_map import FeatureMap
from ds_orchestrator.search.archive import Archive
from ds_orchestrator.search.features import DEFAULT_FEATURES, Cell, cell_of
from ds_orchestrator.store.store import Execution, Test


@dataclass(frozen=True, kw_only=True)
class MapPlan:
    """How a campaign's maps are made.

    Attributes:
        features: names of the axes.
        elites_only: migrate, unite and compare the elites of each run alone, not every test.
        maxitwo_compatible: as in maxitwo: a search's map holds only its elites, turns are counted with its constants,
            and the
            quality of a union is the mean over the pooled tests.
        probability: operator that merges failure probabilities.
        quality_loss: operator that merges lack of quality.
        others: further operators, each of which makes a map of its own, of both values.
        ignored: tests without whose outcome their search went on, even if they have one by now.
    """

    features: tuple[str, ...] = DEFAULT_FEATURES
    elites_only: bool = False
    maxitwo_compatible: bool = False
    probability: str = "product"
    quality_loss: str = "minimum"
    others: tuple[str, ...] = ()
    ignored: frozenset[str] = frozenset()


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
    maxitwo_compatible: bool = False,
) -> dict[str, Cell]:
    """Cell by test, of every test that has one; see `ds_orchestrator.search.features`."""
    at_home = {(e.test_id, e.simulator): e for e in executions if e.outcome.is_verdict}
    cells = {}
    for test in tests:
        cell = cell_of(
            test.road,
            at_home.get((test.test_id, test.sibling)),
            features=features,
            maxitwo_compatible=maxitwo_compatible,
        )
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


def build_maps(
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
    cells = cells_of(tests, verdicts, features=plan.features, maxitwo_compatible=plan.maxitwo_compatible)
    everything = set(cells)
    migrated = elites_of(tests, verdicts, cells, ignored=plan.ignored) if plan.elites_only else everything
    searched = migrated if plan.maxitwo_compatible else everything
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
        maps[f"union_{sibling}"] = union(f"union_{sibling}", parts, pooled_quality_loss=plan.maxitwo_compatible)
    unions = [maps[f"union_{sibling}"] for sibling in siblings]
    maps["merged"] = merge("merged", unions, probability=plan.probability, quality_loss=plan.quality_loss)
    for operator in plan.others:
        name = f"merged_{operator}"
        maps[name] = merge(name, unions, probability=operator, quality_loss=operator)
    if twin:
        parts = [maps[f"migration_{origin}_to_{twin}"] for origin in siblings]
        maps[f"twin_{twin}"] = union(f"twin_{twin}", parts, pooled_quality_loss=plan.maxitwo_compatible)
    return maps
