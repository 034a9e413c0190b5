from .campaign_data import CampaignData, read_campaign
from .config import CampaignConfig, ConfigError, OperatorsConfig, SearchConfig, parse_config, read_config
from .folder import LockError, config_of, locked, open_store, prepare_folder
from .runner import Campaign, CampaignError, Executor, Listener, Stopped
from .status import Stage, stages_of

__all__ = [
    "Campaign",
    "CampaignConfig",
    "CampaignData",
    "CampaignError",
    "ConfigError",
    "Executor",
    "Listener",
    "LockError",
    "OperatorsConfig",
    "SearchConfig",
    "Stage",
    "Stopped",
    "config_of",
    "locked",
    "open_store",
    "parse_config",
    "prepare_folder",
    "read_campaign",
    "read_config",
    "stages_of",
]
