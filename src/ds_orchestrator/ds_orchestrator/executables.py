# SPDX-License-Identifier: Apache-2.0
"""Entry points of this package's executables: what they run lies in packages above this one."""

from __future__ import annotations

import sys
from functools import partial
from importlib import import_module

ABOVE = "ds_cli.ros.executables"
"""Module with a function for each; `ds_bringup` depends on its package, this package cannot."""


def run_above(name: str) -> None:
    """Run an executable; ends in one line where the workspace has only this package and those below it."""
    try:
        module = import_module(ABOVE)
    except ModuleNotFoundError as error:
        if error.name != ABOVE.partition(".")[0]:
            raise
        sys.exit(f"{name}: {error.name} is not in this workspace. Type: colcon build --packages-up-to ds_bringup")
    getattr(module, name)()


campaign = partial(run_above, "campaign")
"""Runs or resumes a campaign on running nodes."""
drive = partial(run_above, "drive")
"""Drives one road on running nodes."""
orchestrator = partial(run_above, "orchestrator")
"""Runs the node that takes campaigns and tests as goals."""
watch = partial(run_above, "watch")
"""Shows a running campaign in the browser."""
