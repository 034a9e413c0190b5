"""The parameters of a simulator's node."""

from __future__ import annotations

import math
from dataclasses import dataclass

from rclpy.node import Node

from ds_sim.ros.parameters import declare

SYNC_MODES = ("lockstep", "first", "realtime")
"""lockstep: only the command with the stamp of the last image counts; first: the first command after it does;
realtime: frames come at 20 Hz by the wall clock, and the last command holds."""


@dataclass(frozen=True)
class SimulatorParameters:
    """What a simulator's node is told at its start.

    Attributes:
        simulator: name of a known simulator, or module:Class.
        sync: one of `SYNC_MODES`; a goal may ask for another.
        command_timeout: longest wait for a command, s of the wall clock; a goal may ask for another.
        publish_clock: publish simulated time on /clock.
    """

    simulator: str
    sync: str
    command_timeout: float
    publish_clock: bool


def declare_parameters(node: Node, simulator: str) -> SimulatorParameters:
    """Declare and read them; `simulator` is the default of the one of that name.

    Raises:
        ValueError: one of another type or out of range.
    """
    return SimulatorParameters(
        simulator=declare(node, "simulator", simulator, "Known simulator, or module:Class."),
        sync=declare(node, "sync", "lockstep", "Which command counts for a frame.", choices=SYNC_MODES),
        command_timeout=declare(
            node, "command_timeout", 5.0, "Longest wait for a command, s of the wall clock.", low=0.01, high=3600.0
        ),
        publish_clock=declare(
            node, "publish_clock", False, "Publish simulated time on /clock; one simulator of a graph may."
        ),
    )


def check_goal(sync: str, command_timeout: float) -> None:
    """Raises ValueError for a goal's wishes that cannot be met; "" and 0 stand for the node's own."""
    if sync not in ("", *SYNC_MODES):
        raise ValueError(f"sync {sync!r}: expected one of {', '.join(SYNC_MODES)}")
    if not 0.0 <= command_timeout < math.inf:
        raise ValueError(f"command_timeout {command_timeout}: expected seconds, or 0 for the node's own")
