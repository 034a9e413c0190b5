"""What a search looks for: the fitness of a test, from its outcomes on one simulator or on several."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

from ds_sim.simulator import HALF_LANE, Outcome


class Driven(Protocol):
    """Outcome of a test on one simulator; `ds_orchestrator.store.Execution` and `ds_sim.session.RunRecord` are such."""

    @property
    def fitness(self) -> float:
        """Smallest lateral distance, m."""
        ...

    @property
    def max_lateral_position(self) -> float:
        """Largest absolute lateral position, m."""
        ...

    @property
    def outcome(self) -> Outcome:
        """How the run ended, a verdict."""
        ...


@dataclass(frozen=True)
class Score:
    """Score of a test, as a search learns it.

    Attributes:
        fitness: lower is better, m; below 0 only where `found`.
        found: the test is what is looked for, so that it stays the elite of its cell.
    """

    fitness: float
    found: bool


@dataclass(frozen=True, kw_only=True)
class Objective:
    """What a search looks for.

    Attributes:
        name: in a configuration.
        everywhere: whether a test is driven on all siblings before the search goes on; else on the search's own.
        score: scores the outcomes, simulator -> outcome, the search's own simulator first.
    """

    name: str
    everywhere: bool
    score: Callable[[Mapping[str, Driven]], Score]


def _lateral_distance(outcomes: Mapping[str, Driven]) -> Score:
    """Smallest lateral distance on the search's own simulator (paper 3.3)."""
    own = next(iter(outcomes.values()))
    return Score(own.fitness, own.outcome.is_failure)


def _boundary(outcomes: Mapping[str, Driven]) -> Score:
    """Distance of the largest lateral position to the lane's edge, on the simulator where it is smallest.

    A test is on the boundary between completing and failing where the car's centre just touches the edge; a failure by
    far is as far from it as an easy test.
    """
    return Score(min(abs(HALF_LANE - one.max_lateral_position) for one in outcomes.values()), found=False)


def _disagreement(outcomes: Mapping[str, Driven]) -> Score:
    """What two siblings lack of differing by half a lane in the largest lateral position; found if verdicts differ.

    Positions beyond the edge count as the edge: how far a car goes after leaving its lane does not tell how it drove.
    """
    lateral = [min(one.max_lateral_position, HALF_LANE) for one in outcomes.values()]
    differ = len({one.outcome.is_failure for one in outcomes.values()}) > 1
    return Score(HALF_LANE - (max(lateral) - min(lateral)), found=differ)


OBJECTIVES: Mapping[str, Objective] = {
    one.name: one
    for one in (
        Objective(name="lateral_distance", everywhere=False, score=_lateral_distance),
        Objective(name="boundary", everywhere=True, score=_boundary),
        Objective(name="disagreement", everywhere=True, score=_disagreement),
    )
}
"""Objectives by name; the first one is the paper's."""
