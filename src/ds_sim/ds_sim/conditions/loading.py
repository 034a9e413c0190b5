"""Loads a test on any simulator, also on one that knows nothing of conditions."""

from __future__ import annotations

from ds_road import Road
from ds_sim.conditions.model import DEFAULT, Conditions, NotApplicableError
from ds_sim.simulator import Observation, Simulator, SimulatorSpec


def load(simulator: Simulator, road: Road, *, seed: int, conditions: Conditions = DEFAULT) -> Observation:
    """Load a road under conditions; a simulator whose `load` does not take conditions has the default ones.

    Raises:
        NotApplicableError: the simulator cannot realise a condition.
        ds_road.RoadError: the road is not valid.
    """
    if conditions.is_default:
        return simulator.load(road, seed=seed)
    check_applicable(conditions, simulator.spec)
    return simulator.load(road, seed=seed, conditions=conditions)


def check_applicable(conditions: Conditions, spec: SimulatorSpec) -> None:
    """Check that a simulator realises all conditions that are not the default.

    Raises:
        NotApplicableError: it does not; one line with those that it realises.
    """
    missing = [name for name in conditions.changed if name not in spec.conditions]
    if missing:
        realised = ", ".join(spec.conditions) or "none"
        raise NotApplicableError(f"{spec.name} cannot realise {', '.join(missing)}: it realises {realised}")
