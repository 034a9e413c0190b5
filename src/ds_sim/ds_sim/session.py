"""One run after the other on one simulator, without ROS: what a host of a simulator has to remember."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from ds_road import Road
from ds_sim.simulator import FRAME_TIME, Command, Observation, Outcome, Simulator, SimulatorError


@dataclass(kw_only=True)
class RunRecord:
    """What happened in one run.

    Attributes:
        road: that was driven.
        seed: of the run.
        observations: one per frame, the first at rest; images are not kept.
        commands: the command that led from frame k to frame k + 1.
        outcome: how it ended, RUNNING until then.
        message: why, in one line, where an outcome alone does not tell.
    """

    road: Road
    seed: int
    observations: list[Observation] = field(default_factory=list)
    commands: list[Command] = field(default_factory=list)
    outcome: Outcome = Outcome.RUNNING
    message: str = ""

    @property
    def fitness(self) -> float:
        """Smallest lateral distance of the run, m, not clipped (paper 3.3)."""
        return min((o.lane.lateral_distance for o in self.observations), default=0.0)

    @property
    def max_lateral_position(self) -> float:
        """Largest absolute lateral position of the run, m: the lack of driving quality (paper 4.2.5)."""
        return max((abs(o.lane.lateral_position) for o in self.observations), default=0.0)

    @property
    def steps(self) -> int:
        """Frames driven."""
        return len(self.commands)

    @property
    def simulated_seconds(self) -> float:
        """Simulated time driven."""
        return self.steps * FRAME_TIME


class Session:
    """Loads roads and drives them, one run at a time.

    Args:
        simulator: any simulator.
    """

    def __init__(self, simulator: Simulator) -> None:
        self.simulator = simulator
        self.run: RunRecord | None = None

    @property
    def driving(self) -> bool:
        """True while a run waits for commands."""
        return self.run is not None and self.run.outcome is Outcome.RUNNING

    def start(self, road: Road, seed: int) -> Observation | None:
        """Begin a run at the start of a road; None, and the run ended as SIM_ERROR, when the simulator broke."""
        self.run = RunRecord(road=road, seed=seed)
        return self._take(lambda: self.simulator.load(road, seed=seed))

    def advance(self, command: Command) -> Observation | None:
        """Drive one frame; None, and the run ended as SIM_ERROR, when the simulator broke."""
        if self.run is None or not self.driving:
            raise SimulatorError("no run is under way: start one first")
        observation = self._take(lambda: self.simulator.step(command))
        if observation is not None:
            self.run.commands.append(command)
        return observation

    def _take(self, act: Callable[[], Observation]) -> Observation | None:
        assert self.run is not None
        try:
            observation = act()
        except Exception as error:  # whatever breaks in a simulator is its error, and never the driver's failure
            self.end(Outcome.SIM_ERROR, f"{type(error).__name__}: {error}".splitlines()[0])
            return None
        self.run.observations.append(_light(observation))
        self.run.outcome = observation.outcome
        return observation

    def end(self, outcome: Outcome, message: str) -> None:
        """End the run from outside: cancelled, or the driver is silent."""
        if self.run is not None and self.run.outcome is Outcome.RUNNING:
            self.run.outcome = outcome
            self.run.message = message


def _light(observation: Observation) -> Observation:
    """An observation without its image, which nobody needs after it was sent."""
    return replace(observation, image=np.empty((0, 0, 3), np.uint8))
