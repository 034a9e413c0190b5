"""Feature maps: tests pooled per cell, united over their origins, merged over siblings (paper 3.3 to 3.5)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from ds_orchestrator.search import Cell
from ds_orchestrator.store import Execution, Test


@dataclass(frozen=True, kw_only=True)
class MapCell:
    """One filled cell of a feature map; a cell without tests is not there at all, which is not the same as 0.

    Attributes:
        tests: tests pooled in it; in a merged map, those of the sibling with the fewest.
        failures: how many of them failed; None in a merged map, whose probability is a product.
        probability: of failure, in [0, 1].
        quality: lack of driving quality, in [0, 1]: mean of the tests' maximum lateral positions, normalised over
            the campaign (paper 4.2.5); the higher the worse.
    """

    tests: int
    failures: int | None
    probability: float
    quality: float


@dataclass(frozen=True, kw_only=True)
class FeatureMap:
    """Cells by (turns count, int(100 x curvature)).

    Attributes:
        name: tells what it is a map of.
        cells: filled cells.
    """

    name: str
    cells: Mapping[Cell, MapCell]


Normalise = Callable[[float], float]
"""From a maximum lateral position in m to [0, 1] over the campaign."""


def normaliser(executions: Iterable[Execution]) -> Normalise:
    """Scale maximum lateral positions to [0, 1] by their range over every simulator of the campaign (paper 4.2.5)."""
    values = [execution.max_lateral_position for execution in executions]
    low, high = min(values, default=0.0), max(values, default=0.0)
    if high == low:
        return lambda value: 0.0
    return lambda value: (value - low) / (high - low)


def pool(name: str, pairs: Iterable[tuple[Test, Execution]], normalise: Normalise) -> FeatureMap:
    """Place every executed test in its cell; pooling the tests of several maps is their union.

    The union of paper 3.4 sums failures and tests over the maps, which is what pooling does. Its quality is the mean
    over the pooled tests, as in maxitwo; the paper's mean of the maps' means weighs a map of one test like one of ten.
    """
    groups: dict[Cell, list[Execution]] = {}
    for test, execution in pairs:
        groups.setdefault(test.cell, []).append(execution)
    cells = {}
    for cell in sorted(groups):
        group = groups[cell]
        failures = sum(e.outcome.is_failure for e in group)
        quality = math.fsum(normalise(e.max_lateral_position) for e in group) / len(group)
        cells[cell] = MapCell(tests=len(group), failures=failures, probability=failures / len(group), quality=quality)
    return FeatureMap(name=name, cells=cells)


def merge(name: str, maps: Sequence[FeatureMap]) -> FeatureMap:
    """Merge the union maps of all siblings: only agreement counts (paper 3.5).

    Failure probability is the product, lack of quality the minimum. A cell that one of the maps leaves empty is
    empty: nobody knows whether that sibling agrees.

    Raises:
        ValueError: no maps.
    """
    if not maps:
        raise ValueError("no maps to merge: expected one union map per sibling")
    shared = set(maps[0].cells).intersection(*(m.cells for m in maps[1:]))
    cells = {}
    for cell in sorted(shared):
        parts = [m.cells[cell] for m in maps]
        cells[cell] = MapCell(
            tests=min(p.tests for p in parts),
            failures=parts[0].failures if len(parts) == 1 else None,
            probability=math.prod(p.probability for p in parts),
            quality=min(p.quality for p in parts),
        )
    return FeatureMap(name=name, cells=cells)


def campaign_maps(
    siblings: Sequence[str], twin: str | None, tests: Sequence[Test], executions: Sequence[Execution]
) -> dict[str, FeatureMap]:
    """Every map of a campaign by name.

    `search_<i>` holds the tests of sibling i on itself, `migration_<i>_to_<j>` those of i on j, `union_<i>` all tests
    on i, `merged` their merge, and `twin_<name>` all tests on the twin. Executions without a verdict enter no map.
    """
    verdicts = [e for e in executions if e.outcome.is_verdict]
    normalise = normaliser(verdicts)
    done = {(e.test_id, e.simulator): e for e in verdicts}

    def on(simulator: str, origins: Sequence[str]) -> list[tuple[Test, Execution]]:
        return [
            (test, done[test.test_id, simulator])
            for test in tests
            if test.sibling in origins and (test.test_id, simulator) in done
        ]

    maps = {}
    for sibling in siblings:
        maps[f"search_{sibling}"] = pool(f"search_{sibling}", on(sibling, [sibling]), normalise)
    for origin in siblings:
        for target in siblings:
            if target != origin:
                name = f"migration_{origin}_to_{target}"
                maps[name] = pool(name, on(target, [origin]), normalise)
    for sibling in siblings:
        maps[f"union_{sibling}"] = pool(f"union_{sibling}", on(sibling, siblings), normalise)
    maps["merged"] = merge("merged", [maps[f"union_{sibling}"] for sibling in siblings])
    if twin:
        maps[f"twin_{twin}"] = pool(f"twin_{twin}", on(twin, siblings), normalise)
    return maps


def to_json(maps: Mapping[str, FeatureMap]) -> dict[str, object]:
    """Maps as plain JSON values; the same maps give the same text."""
    return {
        name: {
            "features": ["turns_count", "curvature_bin"],
            "cells": [
                {
                    "turns_count": cell[0],
                    "curvature_bin": cell[1],
                    "tests": value.tests,
                    "failures": value.failures,
                    "probability": value.probability,
                    "quality": value.quality,
                }
                for cell, value in sorted(feature_map.cells.items())
            ],
        }
        for name, feature_map in maps.items()
    }
