# SPDX-License-Identifier: Apache-2.0
from .copying import recover
from .donkey_tub import Tub, TubError, read_tub
from .info import describe
from .layout import LEVELS, BagError, Level
from .reader import BagReader, RecordedRun, read_run
from .run_writer import write_bag
from .verification import Verification, verify_bag

__all__ = [
    "BagError",
    "BagReader",
    "LEVELS",
    "Level",
    "RecordedRun",
    "Tub",
    "TubError",
    "Verification",
    "describe",
    "read_run",
    "read_tub",
    "recover",
    "verify_bag",
    "write_bag",
]
