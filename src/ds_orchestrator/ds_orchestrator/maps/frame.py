"""Feature maps as one pandas frame."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from ds_orchestrator.maps.feature_map import FeatureMap
from ds_orchestrator.maps.map_id import MapId

if TYPE_CHECKING:
    import pandas as pd

_COLUMNS = ("tests", "failures", "probability", "interval_low", "interval_high", "quality_loss", "excluded")


def maps_frame(maps: Mapping[MapId, FeatureMap]) -> pd.DataFrame:
    """Tabulate maps: one row per map and filled cell.

    Args:
        maps: as `ds_orchestrator.maps.build_maps` returns them; all over the same features.

    Returns:
        Columns `map` (name), `kind`, `simulator`, `origin`, `operator`; one per feature with the cell's bin; `tests`,
        `failures` (missing in merged maps), `probability`, `interval_low`, `interval_high` (95 %), `quality_loss`, and
        `excluded`, the number of tests that the gates exclude.

    Raises:
        ValueError: the maps have different features.
    """
    import pandas as pd

    axes = {feature_map.features for feature_map in maps.values()}
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
