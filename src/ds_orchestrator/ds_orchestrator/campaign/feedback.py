"""Feedback on drives under way, from executors that give any."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Protocol, runtime_checkable

from ds_orchestrator.campaign.runner import Executor
from ds_road import Road
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.session import RunRecord

Watch = Callable[[int, float, float], None]
"""Called during a run with the number of frames, the driven part of the road in [0, 1], and the lateral position, m."""


@runtime_checkable
class FeedbackExecutor(Protocol):
    """Executor that says how far its drives are.

    Attributes:
        gives_feedback: True.
    """

    gives_feedback: bool

    def execute(
        self, simulator: str, road: Road, seed: int, conditions: Conditions = DEFAULT, *, watch: Watch | None = None
    ) -> RunRecord:
        """Drive to an outcome; `watch` is called from another thread."""
        ...


def watched(executor: Executor, watch: Watch | None) -> Callable[[str, Road, int, Conditions], RunRecord]:
    """Return `executor.execute` with `watch` bound to it, if the executor gives feedback."""
    return partial(executor.execute, watch=watch) if isinstance(executor, FeedbackExecutor) else executor.execute
