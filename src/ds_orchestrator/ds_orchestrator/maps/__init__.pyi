from .algebra import merge, pool, union
from .campaign_maps import MapPlan, build_maps
from .feature_map import FeatureMap, MapCell
from .heatmap import draw_map, write_maps
from .merge_operators import OPERATORS, jeffreys_interval

__all__ = [
    "FeatureMap",
    "MapCell",
    "MapPlan",
    "OPERATORS",
    "build_maps",
    "draw_map",
    "jeffreys_interval",
    "merge",
    "pool",
    "union",
    "write_maps",
]
