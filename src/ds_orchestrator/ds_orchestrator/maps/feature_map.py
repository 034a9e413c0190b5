"""Feature maps: tests pooled per cell, united over their origins, merged over siblings (paper 3.3 to 3.5)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from ds_orchestrator.maps.map_id import MapId
from ds_orchestrator.search.features import DEFAULT_FEATURES, Cell, feature_of


@dataclass(frozen=True, kw_only=True)
class MapCell:
    """One filled cell of a feature map; a cell without tests is absent, which is not the same as 0.

    Attributes:
        tests: tests pooled in it; in a merged map, those of the sibling with the fewest.
        failures: how many of them failed; None in a merged map, whose probability is computed from the siblings'.
        probability: of failure, in [0, 1].
        quality_loss: lack of driving quality, in [0, 1]: mean of the tests' maximum lateral positions, normalised over
            the campaign (paper 4.2.5); in a union the mean of its maps' values (paper 3.4); the higher the worse.
        pooled_quality_loss: the same as the mean over all tests of the cell, as in maxitwo; None where it is not known.
        interval: 95 % interval of the probability, or None where the counts behind it are not known.
    """

    tests: int
    failures: int | None
    probability: float
    quality_loss: float
    pooled_quality_loss: float | None = None
    interval: tuple[float, float] | None = None


@dataclass(frozen=True, kw_only=True)
class FeatureMap:
    """Cells by one bin per feature.

    Attributes:
        id: which tests it holds, on which simulator.
        cells: filled cells.
        features: names of the axes; see `ds_orchestrator.search.features`.
        detail: which slice of a map of three features it is, such as `direction coverage, % 10`; "" for a whole map.
    """

    id: MapId
    cells: Mapping[Cell, MapCell]
    features: tuple[str, ...] = DEFAULT_FEATURES
    detail: str = ""

    @property
    def title(self) -> str:
        """Heading of its picture."""
        return ", ".join(filter(None, (self.id.title, self.detail)))


def slices_of(feature_map: FeatureMap) -> list[FeatureMap]:
    """Slice a map of three features into maps of its first two, one per bin of the third; any other map stays whole."""
    if len(feature_map.features) < 3:
        return [feature_map]
    first, second, third = feature_map.features
    of_third = feature_of(third)
    values = sorted({cell[2] for cell in feature_map.cells})
    if not values:
        return [replace(feature_map, features=(first, second))]
    return [
        FeatureMap(
            id=feature_map.id,
            cells={cell[:2]: content for cell, content in feature_map.cells.items() if cell[2] == value},
            features=(first, second),
            detail=f"{of_third.title} {of_third.label(value)}",
        )
        for value in values
    ]


def to_json(maps: Mapping[MapId, FeatureMap]) -> dict[str, object]:
    """Convert maps to plain JSON values by their names; the same maps give the same text."""
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
        }
        for map_id, feature_map in maps.items()
    }
