# SPDX-License-Identifier: Apache-2.0
"""Re-simulates a recorded run: the same road, seed and commands must give the same frames, bit for bit."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from contextlib import closing

from ds_base.errors import RunError
from ds_sim.conditions.model import NotApplicableError
from ds_sim.registry import SimulatorName, make_simulator
from ds_sim.session import RunRecord
from ds_sim.simulator import Observation, SimulatorError


class ResimulationError(RunError):
    """A re-simulated run differs from its recording.

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
