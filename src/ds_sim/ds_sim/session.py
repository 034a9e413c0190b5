# SPDX-License-Identifier: Apache-2.0
"""Drives one run after the other on a simulator and records them, without ROS."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ds_sim.scenario import OfScenario, Scenario
from ds_sim.simulator import (
    FRAME_TIME,
    Command,
    Observation,
    Outcome,
    OutOfSightError,
    Reason,
    Simulator,
    SimulatorError,
)

NO_IMAGE: NDArray[np.uint8] = np.empty((0, 0, 3), np.uint8)
"""Image of an observation that is kept without one."""
NO_IMAGE.setflags(write=False)


@dataclass(kw_only=True)
class RunRecord(OfScenario):
    """Record of one run.

    Attributes:
        scenario: road that was driven, operating conditions, and seed of the run.
        observations: one per frame, the first at rest, without images.
        commands: command k led from frame k to frame k + 1.
        outcome: how the run ended; RUNNING until then.
        message: one line of explanation where the outcome alone is not enough.
        reason: the same for programs.
        visible_contrasts: contrast of the lines in every tenth frame, if it was measured; see `ds_sim.gates`.
    """

    scenario: Scenario
    observations: list[Observation] = field(default_factory=list)
    commands: list[Command] = field(default_factory=list)
    outcome: Outcome = Outcome.RUNNING
    message: str = ""
    reason: Reason = Reason.NONE
    visible_contrasts: list[float] = field(default_factory=list)

    @property
    def fitness(self) -> float:
        """Smallest lateral distance of the run, m, not clipped (paper 3.3)."""
        return min((o.lane.lateral_distance for o in self.observations), default=0.0)

    @property
    def max_lateral_position(self) -> float:
        """Largest absolute lateral position of the run, m: the loss of driving quality (paper 4.2.5)."""
        return max((abs(o.lane.lateral_position) for o in self.observations), default=0.0)

    @property
    def steps(self) -> int:
        """Number of steps driven."""
        return len(self.commands)

    @property
    def simulated_seconds(self) -> float:
        """Simulated time driven, s."""
        return self.steps * FRAME_TIME


class Session:
    """Runs a simulator, one run at a time, and records each run.

    Args:
        simulator: any simulator.

    Attributes:
        run: record of the current or last run; None before the first.

    Examples:
        >>> from ds_road import Road
        >>> from ds_sim import Command, Scenario, Session, make_simulator
        >>> session = Session(make_simulator("softbody"))
        >>> frame = session.start(Scenario(Road([(125, 0), (125, 25), (125, 50), (125, 75)]), seed=1))
        >>> while session.driving:
        ...     frame = session.advance(Command(steering=1.0, throttle=0.5))
        >>> session.run.outcome.name, session.run.fitness < 0.0
        ('OUT_OF_BOUNDS', True)
    """

    def __init__(self, simulator: Simulator) -> None:
        self.simulator = simulator
        self.run: RunRecord | None = None

    @property
    def driving(self) -> bool:
        """True while a run is in progress."""
        return self.run is not None and self.run.outcome is Outcome.RUNNING

    def start(self, scenario: Scenario) -> Observation | None:
        """Start a run at the beginning of a scenario's road.

        Returns:
            First observation; None if the simulator failed, which ends the run as SIM_ERROR.

        Raises:
            ds_sim.NotApplicableError: the simulator cannot realise a condition; no run is made of that.
        """
        self.simulator.spec.check(scenario.conditions)
        self.run = RunRecord(scenario=scenario)
        return self._record(
            lambda: self.simulator.load(scenario.road, seed=scenario.seed, conditions=scenario.conditions)
        )

    def advance(self, command: Command) -> Observation | None:
        """Drive one step.

        Returns:
            Next observation; None if the simulator failed, which ends the run as SIM_ERROR.

        Raises:
            SimulatorError: no run is in progress.
        """
        if self.run is None or not self.driving:
            raise SimulatorError("no run is in progress: start one first")
        observation = self._record(lambda: self.simulator.step(command))
        if observation is not None:
            self.run.commands.append(command)
        return observation

    def _record(self, act: Callable[[], Observation]) -> Observation | None:
        assert self.run is not None
        try:
            observation = act()
        except Exception as error:  # any exception is a simulator error, never a failure of the driver
            reason = Reason.OUT_OF_SIGHT if isinstance(error, OutOfSightError) else Reason.NONE
            self.end(Outcome.SIM_ERROR, f"{type(error).__name__}: {error}".splitlines()[0], reason)
            return None
        self.run.observations.append(_without_image(observation))
        self.run.outcome = observation.outcome
        return observation

    def end(self, outcome: Outcome, message: str, reason: Reason = Reason.NONE) -> None:
        """End the run from outside, for example when it is cancelled or the driver is silent."""
        if self.run is not None and self.run.outcome is Outcome.RUNNING:
            self.run.outcome = outcome
            self.run.message = message
            self.run.reason = reason


def _without_image(observation: Observation) -> Observation:
    """Drop the image of an observation, which is not needed once it has been sent."""
    return Observation(  # not `dataclasses.replace`, which takes five times as long, for each frame
        image=NO_IMAGE,
        step=observation.step,
        time=observation.time,
        vehicle=observation.vehicle,
        lane=observation.lane,
        outcome=observation.outcome,
    )
