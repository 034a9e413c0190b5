"""Maps of the same tests over further features, as pictures for the report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from ds_orchestrator.maps.feature_map import FeatureMap
from ds_orchestrator.maps.heatmap import draw_overview
from ds_orchestrator.maps.map_id import MapId, compared_ids
from ds_orchestrator.report.data_address import data_address
from ds_orchestrator.search.features import feature_of


@dataclass(frozen=True, kw_only=True)
class FurtherMap:
    """Siblings, merged map and twin over one pair of features.

    Attributes:
        title: both features, without units.
        description: in words, which cells fail, for readers who do not see the picture.
        folder: folder of the maps' files, relative to the campaign's.
        address: picture of the failure probabilities as a `data:` address.
    """

    title: str
    description: str
    folder: str
    address: str


def further_map(axes: tuple[str, ...], maps: Mapping[MapId, FeatureMap]) -> FurtherMap:
    """Draw the maps of a campaign over two features.

    Args:
        axes: names of the two features.
        maps: maps of the campaign over them.

    Raises:
        ValueError: there are no maps to compare, or not two features.
    """
    picture = draw_overview(maps, ["probability"])
    if picture is None:
        raise ValueError(f"maps over {', '.join(axes)} cannot be drawn: two features and at least one map are needed")
    across, up = (feature_of(name).title.partition(",")[0] for name in axes)
    return FurtherMap(
        title=f"{up} by {across}",
        description="; ".join(_failing(maps[map_id]) for map_id in compared_ids(maps)),
        folder=f"maps/{'_by_'.join(axes)}",
        address=data_address(picture),
    )


def _failing(feature_map: FeatureMap) -> str:
    failing = sum(cell.probability > 0 for cell in feature_map.cells.values())
    return f"{feature_map.title}: failures in {failing} of {len(feature_map.cells)} cells"
