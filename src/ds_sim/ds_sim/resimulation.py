"""Drives a recorded run again: the same road, seed and commands give the same frames, bit for bit."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator

from ds_sim.registry import make_simulator
from ds_sim.session import RunRecord
from ds_sim.simulator import Observation, SimulatorError


class ResimulationError(RuntimeError):
    """A run that did not come out as it was recorded.

    Attributes:
        step: the first one that differs.
        difference: in words.
    """

    def __init__(self, simulator: str, step: int, difference: str) -> None:
        super().__init__(
            f"{simulator} leaves the recorded run at step {step}, {difference}: it was recorded with another version, "
            "or on another simulator"
        )
        self.step = step
        self.difference = difference


def resimulate(simulator_name: str, run: RunRecord) -> Iterator[Observation]:
    """Every observation of a recorded run, with its image, from a simulator in this process.

    Args:
        simulator_name: as the registry knows it.
        run: recorded, from its first frame on.

    Raises:
        ResimulationError: a frame differs from the recorded one; names the step and how far apart they are.
    """
    simulator = make_simulator(simulator_name)
    try:
        for step, recorded in enumerate(run.observations):
            try:
                seen = simulator.step(run.commands[step - 1]) if step else simulator.load(run.road, seed=run.seed)
            except SimulatorError as error:
                raise ResimulationError(simulator_name, step, f"where it goes no further ({error})") from None
            if difference := difference_between(seen, recorded):
                raise ResimulationError(simulator_name, step, difference)
            yield seen
    finally:
        simulator.close()


def difference_between(seen: Observation, recorded: Observation) -> str:
    """What is not the same to the last bit, in words; "" if nothing. Images are not compared."""
    apart = {
        name: abs(getattr(a, name) - getattr(b, name))
        for a, b in ((seen.vehicle, recorded.vehicle), (seen.lane, recorded.lane))
        for name in a.__dataclass_fields__
        if struct.pack("<d", getattr(a, name)) != struct.pack("<d", getattr(b, name))
    }
    if apart:
        metres = math.hypot(seen.vehicle.x - recorded.vehicle.x, seen.vehicle.y - recorded.vehicle.y)
        name = max(apart, key=lambda key: apart[key])
        others = f" and {len(apart) - 1} more" if len(apart) > 1 else ""
        return f"{metres:.3g} m away ({name} by {apart[name]:.3g}{others})"
    if seen.outcome is not recorded.outcome:
        return f"which ends {seen.outcome.name}, not {recorded.outcome.name}"
    return ""
