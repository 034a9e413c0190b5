# SPDX-License-Identifier: Apache-2.0
"""Tests that results do not depend on the substep: halving it changes the autopilot's fitness by less than 2 cm.

`python -m benchmarks.physics convergence` drives more roads; its numbers are in docs/simulators.md.
"""

from __future__ import annotations

import pytest
from benchmarks.physics import cars, drive, fitness_shift, random_roads

from ds_sim.simulator import Outcome


@pytest.mark.parametrize("name", sorted(cars()))
def test_halving_the_substep_changes_the_fitness_by_less_than_two_centimetres(name: str) -> None:
    shifts, _ = fitness_shift(cars()[name], random_roads(3), 2)
    assert 0.0 < max(shifts) < 0.02


@pytest.mark.parametrize("name", sorted(cars()))
def test_the_autopilot_completes_roads_within_the_speed_limit(name: str) -> None:
    car = cars()[name]
    vehicle = car.make(1)
    for road in random_roads(2)[1:]:
        driven = drive(car, vehicle, road)
        assert driven.outcome is Outcome.COMPLETED
        assert driven.path[:, 3].max() * 3.6 < 30.0
    vehicle.close()
