from .campaign_reader import CampaignReader
from .server import ServerError, serve

__all__ = ["CampaignReader", "ServerError", "serve"]
