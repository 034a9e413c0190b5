"""Drives a recorded run again: the same road, seed and commands give the same frames, bit for bit."""

from __future__ import annotations

from collections.abc import Iterator

from ds_sim.registry import make_simulator
from ds_sim.session import RunRecord
from ds_sim.simulator import Observation


class RedriveError(RuntimeError):
    """A run that did not come out as it was recorded."""


def redrive(simulator_name: str, run: RunRecord) -> Iterator[Observation]:
    """Every observation of a recorded run, with its image, from a simulator in this process.

    Args:
        simulator_name: as the registry knows it.
        run: recorded, from its first frame on.

    Raises:
        RedriveError: a frame differs from the recorded one; names the step and how far apart they are.
    """
    simulator = make_simulator(simulator_name)
    try:
        for step, recorded in enumerate(run.observations):
            seen = simulator.step(run.commands[step - 1]) if step else simulator.load(run.road, seed=run.seed)
            if seen.vehicle != recorded.vehicle:
                apart = max(abs(seen.vehicle.x - recorded.vehicle.x), abs(seen.vehicle.y - recorded.vehicle.y))
                raise RedriveError(
                    f"{simulator_name} leaves the recorded run at step {step}, {apart:.3g} m away: "
                    "it was recorded with another version, or on another simulator"
                )
            yield seen
    finally:
        simulator.close()
