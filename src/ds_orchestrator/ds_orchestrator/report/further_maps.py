"""Maps of the same tests over further features, as pictures for the report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from ds_orchestrator.maps.feature_map import FeatureMap
from ds_orchestrator.maps.heatmap import bounds_of, draw_map
from ds_orchestrator.maps.map_id import MapId, compared_ids
from ds_orchestrator.report.data_address import data_address
from ds_orchestrator.search.features import feature_of


@dataclass(frozen=True, kw_only=True)
class FurtherMap:
    """Siblings, merged map and twin over one pair of features.

    Attributes:
        title: both features, without units.
        folder: folder of the maps' files, relative to the campaign's.
        pictures: of the failure probabilities, one per map: in words, which cells fail, for readers who do not see it,
            and the picture as a `data:` address.
    """

    title: str
    folder: str
    pictures: Sequence[tuple[str, str]]


def further_map(axes: tuple[str, ...], maps: Mapping[MapId, FeatureMap]) -> FurtherMap:
    """Draw the maps of a campaign over two features.

    Args:
        axes: names of the two features.
        maps: maps of the campaign over them.
    """
    across, up = (feature_of(name).title.partition(",")[0] for name in axes)
    bounds = bounds_of(maps.values())
    return FurtherMap(
        title=f"{up} by {across}",
        folder=f"maps/{'_by_'.join(axes)}",
        pictures=[
            (_failing(maps[map_id]), data_address(draw_map(maps[map_id], "probability", bounds=bounds)))
            for map_id in compared_ids(maps)
        ],
    )


def _failing(feature_map: FeatureMap) -> str:
    failing = sum(cell.probability > 0 for cell in feature_map.cells.values())
    return f"{feature_map.title}: failures in {failing} of {len(feature_map.cells)} cells"
