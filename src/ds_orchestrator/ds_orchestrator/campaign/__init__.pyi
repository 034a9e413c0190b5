from .config import CampaignConfig, ConfigError, OperatorsConfig, SearchConfig, parse_config, read_config
from .folder import LockError, config_of, locked, open_store, prepare_folder
from .runner import Campaign, CampaignError, Executor, Listener, Stopped
from .status import Stage, stages_of

__all__ = [
    "Campaign",
    "CampaignConfig",
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
    "read_config",
    "stages_of",
]
