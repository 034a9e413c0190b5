"""Feature maps: tests pooled per cell, united over their origins, merged over siblings (paper 3.3 to 3.5)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from ds_orchestrator.search.features import DEFAULT_FEATURES, Cell, feature_of


@dataclass(frozen=True, kw_only=True)
class MapCell:
    """One filled cell of a feature map; a cell without tests is not there at all, which is not the same as 0.

    Attributes:
        tests: tests pooled in it; in a merged map, those of the sibling with the fewest.
        failures: how many of them failed; None in a merged map, whose probability is made of the siblings'.
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
        name: tells what it is a map of.
        cells: filled cells.
        features: names of the axes; see `ds_orchestrator.search.features`.
    """

    name: str
    cells: Mapping[Cell, MapCell]
    features: tuple[str, ...] = DEFAULT_FEATURES


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
                    "quality": value.quality_loss,
                    "pooled_quality": value.pooled_quality_loss,
                }
                for cell, value in sorted(feature_map.cells.items())
            ],
        }
        for name, feature_map in maps.items()
    }
