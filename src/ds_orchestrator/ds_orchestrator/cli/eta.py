"""How long a campaign still drives, from how long its last executions took."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence

REMEMBERED = 30
"""Executions on each simulator whose durations count; chosen: enough to average roads, few enough to follow a machine
that becomes busy."""


class Eta:
    """The simulators of a stage work side by side, the stages one after the other.

    Times are seconds of any steady clock.
    """

    def __init__(self) -> None:
        self._expected: Sequence[Mapping[str, int]] = []
        self._done: dict[tuple[int, str], int] = {}
        self._last: dict[str, float] = {}
        self._took: dict[str, deque[float]] = {}

    def expect(self, stages: Sequence[Mapping[str, int]]) -> None:
        """How many executions each stage has on each simulator, those that are done included."""
        self._expected = stages

    def begin(self, now: float) -> None:
        """A stage begins."""
        self._last = dict.fromkeys((name for stage in self._expected for name in stage), now)

    def finished(self, stage: int, simulator: str, now: float, *, fresh: bool) -> None:
        """An execution is done; one that was done before this session took no time."""
        self._done[stage, simulator] = self._done.get((stage, simulator), 0) + 1
        if fresh:
            took = now - self._last.get(simulator, now)
            self._took.setdefault(simulator, deque(maxlen=REMEMBERED)).append(took)
        self._last[simulator] = now

    def seconds(self) -> float | None:
        """Seconds left; None as long as nothing was driven in this session."""
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
