"""Starts a node so that Ctrl-C ends it at once and silently, also while its libraries are still being imported."""

from __future__ import annotations

import signal
from importlib import import_module


def start(module: str, *arguments: str) -> None:
    """Import a node's module and call its `main`, which takes over the signals."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    import_module(module).main(*arguments)


def simulator() -> None:
    """Host the simulator that the parameter `simulator` names."""
    start("ds_sim.ros.simulator_node")
