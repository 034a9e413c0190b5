# SPDX-License-Identifier: Apache-2.0
from .build import write_all, write_report
from .findings import Findings, summarise
from .heatmap import draw_map, write_maps
from .watch.campaign_state import CampaignReader
from .watch.server import ServerError, serve

__all__ = [
    "CampaignReader",
    "Findings",
    "ServerError",
    "draw_map",
    "serve",
    "summarise",
    "write_all",
    "write_maps",
    "write_report",
]
