# SPDX-License-Identifier: Apache-2.0
"""Drives runs on a simulator and records them, without ROS, and re-simulates what was recorded."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ds_base.errors import RunError
from ds_sim.conditions.model import NotApplicableError
from ds_sim.registry import SimulatorName, make_simulator
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


class ResimulationError(RunError):
    """A re-simulated run differs from its recording, whose road, seed and commands must give the same frames.

    Attributes:
        step: first step that differs.
        difference: description of the difference.
    """

    def __init__(self, simulator: SimulatorName, step: int, difference: str) -> None:
        super().__init__(
            f"{simulator} leaves the recorded run at step {step}, {difference}: it was recorded with another version, "
            "or on another simulator"
        )
        self.step = step
        self.difference = difference


def resimulate(simulator_name: SimulatorName, run: RunRecord) -> Iterator[Observation]:
    """Re-simulate a recorded run in this process and yield every observation with its image.

    Args:
        simulator_name: name known to `ds_sim.registry`.
        run: recorded run, complete from its first frame.

    Raises:
        ResimulationError: a frame differs from the recording; names the step and the size of the difference.
    """
    with closing(make_simulator(simulator_name)) as simulator:
        for step, recorded in enumerate(run.observations):
            try:
                observation = (
                    simulator.step(run.commands[step - 1])
                    if step
                    else simulator.load(run.road, seed=run.seed, conditions=run.conditions)
                )
            except (SimulatorError, NotApplicableError) as error:
                raise ResimulationError(simulator_name, step, f"where the simulator fails ({error})") from None
            if difference := difference_between(observation, recorded):
                raise ResimulationError(simulator_name, step, difference)
            yield observation


def difference_between(observation: Observation, recorded: Observation) -> str:
    """Describe what differs in any bit between two observations; "" if nothing. Images are not compared."""
    differences = {
        name: abs(getattr(a, name) - getattr(b, name))
        for a, b in ((observation.vehicle, recorded.vehicle), (observation.lane, recorded.lane))
        for name in a.__dataclass_fields__
        if struct.pack("<d", getattr(a, name)) != struct.pack("<d", getattr(b, name))
    }
    if differences:
        metres = math.hypot(observation.vehicle.x - recorded.vehicle.x, observation.vehicle.y - recorded.vehicle.y)
        name = max(differences, key=lambda key: differences[key])
        others = f" and {len(differences) - 1} more" if len(differences) > 1 else ""
        return f"{metres:.3g} m away ({name} by {differences[name]:.3g}{others})"
    if observation.outcome is not recorded.outcome:
        return f"which ends {observation.outcome.name}, not {recorded.outcome.name}"
    return ""
