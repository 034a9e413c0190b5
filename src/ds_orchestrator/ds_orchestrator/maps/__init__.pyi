from .algebra import merge, pool, union
from .campaign_maps import MapPlan, build_maps
from .feature_map import FeatureMap, MapCell
from .frame import maps_frame
from .heatmap import draw_map, write_maps
from .map_id import MapId, map_ids
from .merge_operators import OPERATORS, MergeOperator, jeffreys_interval

__all__ = [
    "FeatureMap",
    "MapCell",
    "MapId",
    "MapPlan",
    "MergeOperator",
    "OPERATORS",
    "build_maps",
    "draw_map",
    "jeffreys_interval",
    "map_ids",
    "maps_frame",
    "merge",
    "pool",
    "union",
    "write_maps",
]
