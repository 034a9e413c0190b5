# SPDX-License-Identifier: Apache-2.0
"""One test of a driver: road, operating conditions and seed."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from typing import TYPE_CHECKING

from ds_base.errors import InputError
from ds_sim.conditions.model import DEFAULT, Conditions

if TYPE_CHECKING:
    from ds_road import Road  # NumPy would delay every help text


MAX_SEED = 2**63 - 1
"""Largest seed; chosen: what SQLite and numpy's int64 hold."""


class ScenarioError(InputError):
    """A test that cannot be."""


@dataclass(frozen=True, slots=True)
class Scenario:
    """Road, operating conditions and seed, by which simulator and driver determine every frame of a drive.

    Attributes:
        road: road to drive.
        conditions: operating conditions.
        seed: seed of all that is random in the simulator, 0 to `MAX_SEED`.

    Raises:
        ScenarioError: another seed.
    """

    road: Road
    conditions: Conditions = DEFAULT
    _: KW_ONLY
    seed: int

    def __post_init__(self) -> None:
        if not 0 <= self.seed <= MAX_SEED:
            raise ScenarioError(f"seed {self.seed}: expected a whole number from 0 to {MAX_SEED}")

    @property
    def unseeded(self) -> tuple[str, Conditions]:
        """Road and conditions, which two scenarios that only repeat each other share."""
        return self.road.road_id, self.conditions


class OfScenario:
    """Base class of what holds a scenario; the scenario's parts are its own."""

    scenario: Scenario

    @property
    def road(self) -> Road:
        """Road of the scenario."""
        return self.scenario.road

    @property
    def conditions(self) -> Conditions:
        """Operating conditions of the scenario."""
        return self.scenario.conditions

    @property
    def seed(self) -> int:
        """Seed of the scenario."""
        return self.scenario.seed
