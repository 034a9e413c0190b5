"""Estimates the time that a campaign still takes."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence

REMEMBERED = 30
"""Executions on each simulator whose durations count; chosen: enough to average roads, few enough to follow a machine
that becomes busy."""


class Eta:
    """Estimates how long a campaign still drives, from the durations of its latest executions.

    The simulators of a stage work in parallel, the stages one after the other. Times are seconds of a steady clock.
    """

    def __init__(self) -> None:
        self._expected: Sequence[Mapping[str, int]] = []
        self._done: dict[tuple[int, str], int] = {}
        self._last: dict[str, float] = {}
        self._took: dict[str, deque[float]] = {}

    def expect(self, stages: Sequence[Mapping[str, int]]) -> None:
        """Set how many executions each stage has on each simulator, finished ones included."""
        self._expected = stages

    def begin(self, now: float) -> None:
        """Begin a stage."""
        self._last = dict.fromkeys((name for stage in self._expected for name in stage), now)

    def finished(self, stage: int, simulator: str, now: float, *, fresh: bool) -> None:
        """Count a finished execution; one of an earlier session (not fresh) took no time."""
        self._done[stage, simulator] = self._done.get((stage, simulator), 0) + 1
        if fresh:
            took = now - self._last.get(simulator, now)
            self._took.setdefault(simulator, deque(maxlen=REMEMBERED)).append(took)
        self._last[simulator] = now

    def seconds(self) -> float | None:
        """Estimate the seconds left; None until an execution has finished in this session."""
        means = {name: sum(took) / len(took) for name, took in self._took.items()}
        if not means:
            return None
        # A simulator that has not driven yet is taken to be as fast as the others.
        usual = sum(means.values()) / len(means)
        return sum(
            max(
                (
                    max(count - self._done.get((stage, name), 0), 0) * means.get(name, usual)
                    for name, count in simulators.items()
                ),
                default=0.0,
            )
            for stage, simulators in enumerate(self._expected)
        )
