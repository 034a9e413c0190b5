"""Refusals of requests to a simulator: a reason code and a one-line message."""

from __future__ import annotations

from ds_sim.simulator import Reason


class RequestRefused(ValueError):
    """A simulator's node does not accept a road or a goal.

    Args:
        reason: reason code for programs.
        message: cause and remedy in one line.
    """

    def __init__(self, reason: Reason, message: str) -> None:
        super().__init__(message)
        self.reason = reason


def no_road() -> RequestRefused:
    """Make the refusal of a request that needs a loaded road."""
    return RequestRefused(Reason.NO_ROAD, "no road is loaded: call load_road first, or give one with the goal")
