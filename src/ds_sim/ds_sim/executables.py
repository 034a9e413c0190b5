"""Starts a node such that Ctrl-C ends it at once and silently, even while its libraries are still being imported."""

from __future__ import annotations

import signal
from importlib import import_module


def start(module: str, *arguments: str) -> None:
    """Import a node's module and call its `main`, which installs its own signal handlers.

    Args:
        module: name of the module.
        arguments: passed to its `main`.
    """
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    import_module(module).main(*arguments)


def simulator() -> None:
    """Start the node that hosts the simulator named by the parameter `simulator`."""
    start("ds_sim.ros.simulator_node")
