"""Refusals of requests to a simulator: a reason for programs, one line for people."""

from __future__ import annotations

from ds_sim.simulator import Reason


class RequestRefused(ValueError):
    """A road or a goal that a simulator's node does not accept.

    Args:
        reason: the same as the message, for programs.
        message: what is wrong and what to do, in one line.
    """

    def __init__(self, reason: Reason, message: str) -> None:
        super().__init__(message)
        self.reason = reason


NO_ROAD = RequestRefused(Reason.NO_ROAD, "no road is loaded: call load_road first, or give one with the goal")
