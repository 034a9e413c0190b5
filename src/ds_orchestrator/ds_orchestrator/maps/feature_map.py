# SPDX-License-Identifier: Apache-2.0
"""Identity and content of a feature map, and its forms as JSON and as a pandas frame."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

from ds_orchestrator.search.features import DEFAULT_AXES, Cell, Feature
from ds_sim.registry import NO_SIMULATOR, SimulatorName

if TYPE_CHECKING:
    import pandas as pd

Kind = Literal["search", "migration", "union", "merged", "twin"]
"""search: a sibling's tests on itself; migration: one sibling's tests on another simulator; union: all tests on a
sibling; merged: the siblings' unions merged; twin: all tests on the twin."""


@dataclass(frozen=True, kw_only=True)
class MapId:
    """Identity of one feature map; use the constructors, which set the attributes of each kind.

    Attributes:
        kind: which tests on which simulator.
        simulator: simulator on which the tests were driven; "" for a merged map.
        origin: sibling whose search generated the tests; "" if the map holds tests of all siblings.
        operator: operator that merged the siblings; "" for the configured ones and for maps that are not merged.

    Examples:
        >>> from ds_orchestrator import MapId
        >>> MapId.union("bullet").name, MapId.twin("donkey").title
        ('union_bullet', 'Twin donkey')
    """

    kind: Kind
    simulator: SimulatorName = NO_SIMULATOR
    origin: SimulatorName = NO_SIMULATOR
    operator: str = ""

    @classmethod
    def search(cls, sibling: SimulatorName) -> MapId:
        """Tests of a sibling's search, driven on that sibling."""
        return cls(kind="search", simulator=sibling, origin=sibling)

    @classmethod
    def migration(cls, origin: SimulatorName, target: SimulatorName) -> MapId:
        """Tests of one sibling's search, driven on another sibling or on the twin."""
        return cls(kind="migration", simulator=target, origin=origin)

    @classmethod
    def union(cls, sibling: SimulatorName) -> MapId:
        """Tests of all searches, driven on one sibling (paper 3.4)."""
        return cls(kind="union", simulator=sibling)

    @classmethod
    def merged(cls, operator: str = "") -> MapId:
        """Unions of all siblings merged (paper 3.5), by the configured operators if none is named."""
        return cls(kind="merged", operator=operator)

    @classmethod
    def twin(cls, twin: SimulatorName) -> MapId:
        """Tests of all searches, driven on the twin (paper 3.6)."""
        return cls(kind="twin", simulator=twin)

    @property
    def name(self) -> str:
        """Key in JSON documents and stem of file names, such as `migration_bullet_to_softbody`."""
        rest = f"{self.origin}_to_{self.simulator}" if self.kind == "migration" else self.simulator or self.operator
        return f"{self.kind}_{rest}" if rest else self.kind

    @property
    def title(self) -> str:
        """Heading of a picture, such as `All tests on bullet`."""
        if self.kind == "migration":
            return f"Migration: {self.origin} to {self.simulator}"
        words = {"search": "Search on", "union": "All tests on", "merged": "Siblings merged", "twin": "Twin"}
        return f"{words[self.kind]} {self.simulator or self.operator}".strip()


def map_ids(
    siblings: Sequence[SimulatorName], twin: SimulatorName | None, operators: Sequence[str] = ()
) -> list[MapId]:
    """Identities of every map of a campaign, in the order of writing; each further operator adds a merged map."""
    targets = [*siblings, *([twin] if twin else [])]
    return [
        *(MapId.search(sibling) for sibling in siblings),
        *(MapId.migration(origin, target) for origin in siblings for target in targets if target != origin),
        *(MapId.union(sibling) for sibling in siblings),
        MapId.merged(),
        *(MapId.merged(operator) for operator in operators),
        *([MapId.twin(twin)] if twin else []),
    ]


def compared_ids(ids: Iterable[MapId]) -> list[MapId]:
    """Select the maps to show side by side: unions, their merge by the configured operators, the twin."""
    return [map_id for map_id in ids if map_id.kind in ("union", "twin") or map_id == MapId.merged()]


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
        interval: 95% interval of the probability, or None if the counts are not known.
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
        features: the axes.
        detail: slice of a map of three features, such as `direction coverage, % 10`; "" for a whole map.
        excluded: number of tests by which no network can be judged on this simulator (`ds_sim.gates`), by cell; they
            are in no other number.
    """

    id: MapId
    cells: Mapping[Cell, MapCell]
    features: tuple[Feature, ...] = DEFAULT_AXES
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
    values = sorted({cell[2] for cell in (*feature_map.cells, *feature_map.excluded)})
    if not values:
        return [replace(feature_map, features=(first, second))]
    return [
        FeatureMap(
            id=feature_map.id,
            cells={cell[:2]: content for cell, content in feature_map.cells.items() if cell[2] == value},
            features=(first, second),
            detail=f"{third.title} {third.label(value)}",
            excluded={cell[:2]: count for cell, count in feature_map.excluded.items() if cell[2] == value},
        )
        for value in values
    ]


def to_json(maps: Mapping[MapId, FeatureMap]) -> dict[str, object]:
    """Convert maps to JSON values by name; equal maps give equal text."""
    return {
        map_id.name: {
            "features": [feature.axis for feature in feature_map.features],
            "cells": [
                {
                    **_bins(feature_map, cell),
                    "tests": value.tests,
                    "failures": value.failures,
                    "probability": value.probability,
                    "interval": None if value.interval is None else list(value.interval),
                    "quality": value.quality_loss,
                    "pooled_quality": value.pooled_quality_loss,
                }
                for cell, value in sorted(feature_map.cells.items())
            ],
            # Nothing where there are none, as in campaigns without gates.
            **({"excluded": excluded} if (excluded := _excluded_to_json(feature_map)) else {}),
        }
        for map_id, feature_map in maps.items()
    }


def _bins(feature_map: FeatureMap, cell: Cell) -> dict[str, int]:
    return {feature.axis: bin_ for feature, bin_ in zip(feature_map.features, cell, strict=True)}


def _excluded_to_json(feature_map: FeatureMap) -> list[dict[str, int]]:
    return [{**_bins(feature_map, cell), "tests": count} for cell, count in sorted(feature_map.excluded.items())]


_COLUMNS = ("tests", "failures", "probability", "interval_low", "interval_high", "quality_loss", "excluded")


def maps_frame(maps: Mapping[MapId, FeatureMap]) -> pd.DataFrame:
    """Tabulate maps: one row per map and filled cell.

    Args:
        maps: as `ds_orchestrator.build_maps` returns them; all over the same features.

    Returns:
        Columns `map` (name), `kind`, `simulator`, `origin`, `operator`; one per feature with the cell's bin; `tests`,
        `failures` (missing in merged maps), `probability`, `interval_low`, `interval_high` (95%), `quality_loss`, and
        `excluded`, the number of tests that the gates exclude.

    Raises:
        ValueError: the maps have different features.
    """
    import pandas as pd

    axes = {tuple(feature.axis for feature in feature_map.features) for feature_map in maps.values()}
    if len(axes) > 1:
        raise ValueError(f"maps of different features: {' and '.join(map(str, sorted(axes)))}; make one frame of each")
    features = next(iter(axes), ())
    rows: list[list[Any]] = []
    for map_id, feature_map in maps.items():
        identity = [map_id.name, map_id.kind, map_id.simulator, map_id.origin, map_id.operator]
        for cell, content in sorted(feature_map.cells.items()):
            low, high = content.interval or (None, None)
            values = [content.tests, content.failures, content.probability, low, high, content.quality_loss]
            values.append(feature_map.excluded.get(cell, 0))
            rows.append([*identity, *cell, *values])
    frame = pd.DataFrame(rows, columns=["map", "kind", "simulator", "origin", "operator", *features, *_COLUMNS])
    kinds = {"tests": "int64", "failures": "Int64", **dict.fromkeys(_COLUMNS[2:-1], "float64"), "excluded": "int64"}
    return frame.astype({**kinds, **dict.fromkeys(features, "int64")})
