"""Feature maps and their cells (paper 3.3 to 3.5)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from ds_orchestrator.maps.map_id import MapId
from ds_orchestrator.search.features import DEFAULT_FEATURES, Cell, feature_of


@dataclass(frozen=True, kw_only=True)
class MapCell:
    """Filled cell of a feature map; a cell without tests is absent, which differs from 0.

    Attributes:
        tests: number of pooled tests; in a merged map, the smallest number of any sibling.
        failures: number of failed tests; None in a merged map, whose probability is computed from the siblings'.
        probability: failure probability, in [0, 1].
        quality_loss: loss of driving quality, in [0, 1], higher is worse: mean of the tests' maximum lateral positions,
            normalised over the campaign (paper 4.2.5); in a union, the mean of its maps' values (paper 3.4).
        pooled_quality_loss: the same as the mean over all tests of the cell, as in maxitwo; None if not known.
        interval: 95 % interval of the probability, or None if the counts are not known.
    """

    tests: int
    failures: int | None
    probability: float
    quality_loss: float
    pooled_quality_loss: float | None = None
    interval: tuple[float, float] | None = None


@dataclass(frozen=True, kw_only=True)
class FeatureMap:
    """Grid of cells, one axis per feature.

    Attributes:
        id: identity: which tests on which simulator.
        cells: filled cells.
        features: names of the axes; see `ds_orchestrator.search.features`.
        detail: slice of a map of three features, such as `direction coverage, % 10`; "" for a whole map.
        excluded: number of tests by which no network can be judged on this simulator (`ds_sim.gates`), by cell; they
            are in no other number.
    """

    id: MapId
    cells: Mapping[Cell, MapCell]
    features: tuple[str, ...] = DEFAULT_FEATURES
    detail: str = ""
    excluded: Mapping[Cell, int] = field(default_factory=dict)

    @property
    def title(self) -> str:
        """Heading of the map's picture."""
        return ", ".join(filter(None, (self.id.title, self.detail)))


def slices_of(feature_map: FeatureMap) -> list[FeatureMap]:
    """Slice a map of three features into maps of the first two, one per bin of the third; keep other maps whole."""
    if len(feature_map.features) < 3:
        return [feature_map]
    first, second, third = feature_map.features
    of_third = feature_of(third)
    values = sorted({cell[2] for cell in (*feature_map.cells, *feature_map.excluded)})
    if not values:
        return [replace(feature_map, features=(first, second))]
    return [
        FeatureMap(
            id=feature_map.id,
            cells={cell[:2]: content for cell, content in feature_map.cells.items() if cell[2] == value},
            features=(first, second),
            detail=f"{of_third.title} {of_third.label(value)}",
            excluded={cell[:2]: count for cell, count in feature_map.excluded.items() if cell[2] == value},
        )
        for value in values
    ]


def to_json(maps: Mapping[MapId, FeatureMap]) -> dict[str, object]:
    """Convert maps to JSON values by name; equal maps give equal text."""
    return {
        map_id.name: {
            "features": list(feature_map.features),
            "cells": [
                {
                    **dict(zip(feature_map.features, cell, strict=True)),
                    "tests": value.tests,
                    "failures": value.failures,
                    "probability": value.probability,
                    "interval": None if value.interval is None else list(value.interval),
                    "quality": value.quality_loss,
                    "pooled_quality": value.pooled_quality_loss,
                }
                for cell, value in sorted(feature_map.cells.items())
            ],
            **_excluded_to_json(feature_map),
        }
        for map_id, feature_map in maps.items()
    }


def _excluded_to_json(feature_map: FeatureMap) -> dict[str, object]:
    """Cells with excluded tests; nothing where there are none, as in campaigns without gates."""
    if not feature_map.excluded:
        return {}
    return {
        "excluded": [
            {**dict(zip(feature_map.features, cell, strict=True)), "tests": count}
            for cell, count in sorted(feature_map.excluded.items())
        ]
    }
