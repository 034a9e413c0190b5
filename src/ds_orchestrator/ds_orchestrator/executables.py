# SPDX-License-Identifier: Apache-2.0
"""Entry points of this package's executables: what they run lies in packages above this one."""

from __future__ import annotations

import sys
from functools import partial
from importlib.util import find_spec

from ds_base.executables import start

ABOVE = "ds_cli.ros.executables"
"""Module that runs each by its name; `ds_bringup` depends on its package, this package cannot."""


def run_above(name: str) -> None:
    """Run an executable; ends in one line where the workspace has only this package and those below it."""
    package = ABOVE.partition(".")[0]
    if find_spec(package) is None:
        sys.exit(f"{name}: {package} is not in this workspace. Type: colcon build --packages-up-to ds_bringup")
    start(ABOVE, name)


campaign, drive, orchestrator, watch = (
    partial(run_above, name) for name in ("campaign", "drive", "orchestrator", "watch")
)
"""Run or resume a campaign, or drive a road, on running nodes; take goals as a node; show a campaign in the browser."""
