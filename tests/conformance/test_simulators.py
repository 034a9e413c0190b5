"""What every simulator promises: `ds_sim.testing` on each of them, and on simulators that break a promise."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ds_road import Road
from ds_sim.registry import SIMULATORS, UnknownSimulatorError, make_simulator
from ds_sim.simulator import Command, CommandError, Observation
from ds_sim.testing import CHECKS, STRAIGHT, SimulatorCheckError, check_simulator, drive, run_check
from ds_sim_softbody.simulator import SoftbodySimulator


@pytest.mark.parametrize("check", CHECKS)
def test_a_simulator_keeps_its_promise(simulator_name: str, check: str) -> None:
    run_check(check, simulator_name)


class MirroredSimulator(SoftbodySimulator):
    """Steers right where it should steer left."""

    def step(self, command: Command) -> Observation:
        return super().step(Command(-command.steering, command.throttle))


class RestlessSimulator(SoftbodySimulator):
    """Moves the world by a centimetre with every run."""

    def __init__(self) -> None:
        super().__init__()
        self._loads = 0

    def load(self, road: Road, *, seed: int) -> Observation:
        self._loads += 1
        return super().load(Road([(x + 0.01 * self._loads, y) for x, y in road.control_points]), seed=seed)


def test_broken_promises_are_named_with_what_was_found() -> None:
    quick = {"left_is_left", "same_bits_again", "run_begins_at_rest"}
    with pytest.raises(SimulatorCheckError, match=r"^left_is_left: steering -0\.5 \(left\): change of yaw is -0"):
        check_simulator(MirroredSimulator, skip=set(CHECKS) - quick)
    with pytest.raises(SimulatorCheckError, match="^same_bits_again: the same road, seed and commands gave other"):
        check_simulator(RestlessSimulator, skip=set(CHECKS) - quick)


def test_a_check_that_does_not_exist_cannot_be_skipped() -> None:
    with pytest.raises(ValueError, match="unknown check lef_is_left: expected some of same_bits_again"):
        check_simulator("bullet", skip={"lef_is_left"})


@pytest.mark.parametrize(
    "values", [(math.nan, 0.0), (0.0, math.inf), (1.01, 0.0), (-2.0, 0.5), (0.0, -0.1), (0.0, 1.1)]
)
def test_a_command_out_of_range_cannot_be_made(values: tuple[float, float]) -> None:
    with pytest.raises(CommandError, match="expected a number"):
        Command(*values)


@pytest.mark.parametrize("name", ["", "bulet", "ds_sim:Nothing", "no.such.module:Thing"])
def test_an_unknown_simulator_is_named(name: str) -> None:
    with pytest.raises(UnknownSimulatorError):
        make_simulator(name)


def test_the_simulators_differ() -> None:
    """Same road, same commands, three trajectories: complementary, not copies."""
    ends = []
    for name in sorted(SIMULATORS):
        simulator = make_simulator(name)
        end = drive(simulator, STRAIGHT, lambda o: Command(0.05 if o.time > 2.0 else 0.0, 0.7), steps=80)[-1]
        ends.append((end.vehicle.x, end.vehicle.y))
        simulator.close()
    assert len(ends) == 3 and min(math.dist(a, b) for i, a in enumerate(ends) for b in ends[:i]) > 0.1
    assert np.isfinite(ends).all()
