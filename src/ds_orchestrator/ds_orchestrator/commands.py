"""What the verbs of `ds` do, each returning a result that can be shown to a person or written as JSON."""

from __future__ import annotations

import importlib.metadata
import json
import platform
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

import ds_road
from ds_orchestrator import config as configuration
from ds_orchestrator import results
from ds_orchestrator.campaign import Campaign, Stopped, execution_of
from ds_orchestrator.config import CampaignConfig
from ds_orchestrator.progress import ScreenWatcher
from ds_orchestrator.store import Store
from ds_sim.registry import SIMULATORS, UnknownSimulatorError

read_config = configuration.read_config


class Interrupted(Exception):
    """The user stopped a command."""


@dataclass(frozen=True, kw_only=True)
class Result:
    """What a verb found out.

    Attributes:
        document: as JSON values.
        show: shows it to a person.
        error: True if a run ended in an error.
    """

    document: Any
    show: Callable[[], None] = field(default=lambda: None)
    error: bool = False
