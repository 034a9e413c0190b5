"""Parameters of a simulator's node, and the goal options that override them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from rclpy.node import Node

from ds_sim.conditions.model import Conditions
from ds_sim.conditions.text import parse_conditions
from ds_sim.ros.loaded_road import RequestRefused
from ds_sim.ros.parameters import declare
from ds_sim.simulator import Reason

SYNC_MODES = ("lockstep", "first", "realtime")
"""lockstep: only the command with the stamp of the last image counts; first: the first command after the last image
counts; realtime: frames come at 20 Hz by the wall clock, and the last command is held."""


@dataclass(frozen=True)
class SimulatorParameters:
    """Parameters of a simulator's node.

    Attributes:
        simulator: name of a known simulator, or module:Class.
        sync: one of `SYNC_MODES`; a goal may override it.
        command_timeout: longest wait for a command by the wall clock, s; a goal may override it.
        publish_clock: publish simulated time on /clock.
        conditions: operating conditions of runs that bring none.
    """

    simulator: str
    sync: str
    command_timeout: float
    publish_clock: bool
    conditions: Conditions


def declare_parameters(node: Node, simulator: str) -> SimulatorParameters:
    """Declare and read the parameters.

    Args:
        node: node that declares the parameters.
        simulator: default of the parameter `simulator`.

    Raises:
        ValueError: a parameter has another type or is out of range.
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
        conditions=parse_conditions(
            declare(
                node,
                "conditions",
                "",
                "Conditions of runs that bring none, such as visibility=40,friction=0.6.",
            )
        ),
    )


def check_goal(sync: str, command_timeout: float) -> None:
    """Check the options of a goal; "" and 0 mean the node's parameters.

    Raises:
        RequestRefused: BAD_GOAL.
    """
    if sync not in ("", *SYNC_MODES):
        raise RequestRefused(Reason.BAD_GOAL, f"sync {sync!r}: expected one of {', '.join(SYNC_MODES)}")
    if not 0.0 <= command_timeout < math.inf:
        message = f"command_timeout {command_timeout}: expected seconds, or 0 for the node's own"
        raise RequestRefused(Reason.BAD_GOAL, message)
