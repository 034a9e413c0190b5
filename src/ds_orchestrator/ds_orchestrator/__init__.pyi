# SPDX-License-Identifier: Apache-2.0
from .campaign.config import CampaignConfig, ConfigError, OperatorsConfig, SearchConfig, parse_config, read_config
from .campaign.engine import DriveSettings, Engine
from .campaign.executor import CampaignError, Executor, Listener, Stopped
from .campaign.folder import CampaignData, config_of, open_store, prepare_folder, read_campaign
from .campaign.runner import Campaign
from .campaign.status import Stage, stages_of
from .engines.drive_tests import Callbacks, DriveResults, drive_tests
from .maps.algebra import OPERATORS, MergeOperator, merge, pool, union
from .maps.campaign_maps import MapPlan, build_maps
from .maps.feature_map import FeatureMap, MapCell, MapId, map_ids, maps_frame
from .search.algorithms import (
    SEARCHES,
    Archive,
    ConditionSpace,
    DeepHyperion,
    DeepHyperionCS,
    Elite,
    RandomSearch,
    Search,
    SearchedCondition,
    SearchSettings,
)
from .search.features import FEATURES, Cell, cell_of, feature_of
from .store.model import Execution, Origin, Test
from .store.store import Store

__all__ = [
    "Callbacks",
    "Archive",
    "Campaign",
    "CampaignConfig",
    "CampaignData",
    "CampaignError",
    "Cell",
    "ConditionSpace",
    "ConfigError",
    "DeepHyperion",
    "DeepHyperionCS",
    "DriveSettings",
    "Elite",
    "Engine",
    "Execution",
    "Executor",
    "FEATURES",
    "FeatureMap",
    "DriveResults",
    "Listener",
    "MapCell",
    "MapId",
    "MapPlan",
    "MergeOperator",
    "OPERATORS",
    "OperatorsConfig",
    "Origin",
    "RandomSearch",
    "SEARCHES",
    "Search",
    "SearchConfig",
    "SearchSettings",
    "SearchedCondition",
    "Stage",
    "Stopped",
    "Store",
    "Test",
    "build_maps",
    "cell_of",
    "config_of",
    "drive_tests",
    "feature_of",
    "map_ids",
    "maps_frame",
    "merge",
    "open_store",
    "parse_config",
    "pool",
    "prepare_folder",
    "read_campaign",
    "read_config",
    "stages_of",
    "union",
]
