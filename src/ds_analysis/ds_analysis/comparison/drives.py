"""What a comparison of two networks is made of: the same test, driven by both on the same simulator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ds_orchestrator.search.features import Cell
from ds_orchestrator.store.model import Execution
from ds_road import Road
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.simulator import Outcome

Change = Literal["newly fails", "fixed", "fails in both", "passes in both"]
CHANGES: Mapping[tuple[bool, bool], Change] = {
    (False, True): "newly fails",
    (True, False): "fixed",
    (True, True): "fails in both",
    (False, False): "passes in both",
}
"""Whether the reference and the candidate fail -> the change."""


class ComparisonError(ValueError):
    """Networks, campaigns or suites that cannot be compared."""


@dataclass(frozen=True, kw_only=True)
class Network:
    """One side of a comparison.

    Attributes:
        driver: name of the driver, with its backend and generators.
        sha256: digest of its files; "" for the autopilot, or if it is not known.
    """

    driver: str
    sha256: str = ""

    @property
    def label(self) -> str:
        """Name with the first digits of the digest."""
        return f"{self.driver} ({self.sha256[:8]})" if self.sha256 else self.driver


@dataclass(frozen=True, kw_only=True)
class ComparedTest:
    """Test that both networks drive.

    Attributes:
        name: unique in the comparison, and safe within a file name.
        road: road to drive.
        seed: seed of the run.
        conditions: operating conditions of the run.
        cell: cell of the feature map, or None if it has none.
        unsearched: chosen without looking at any network's outcome, such as a random road.
    """

    name: str
    road: Road
    seed: int
    conditions: Conditions = DEFAULT
    cell: Cell | None = None
    unsearched: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class DriveOutcome:
    """How one network drove a test on one simulator.

    Attributes:
        outcome: a verdict.
        fitness: smallest lateral distance, m; below 0 out of the lane.
        trajectory_sha256: digest of the trajectory.
        simulated_seconds: simulated time driven, s.
        path: (n, 2) positions, m; empty if they are not known.
    """

    outcome: Outcome
    fitness: float
    trajectory_sha256: str = ""
    simulated_seconds: float = 0.0
    path: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 2)))

    @classmethod
    def of(cls, execution: Execution) -> DriveOutcome:
        """Outcome of a stored execution."""
        return cls(
            outcome=execution.outcome,
            fitness=execution.fitness,
            trajectory_sha256=execution.trajectory_sha256,
            simulated_seconds=execution.simulated_seconds,
            path=execution.trajectory[:, :2],
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class PairedDrive:
    """One test on one simulator, driven by both networks.

    Attributes:
        test: the test.
        simulator: name of the simulator.
        reference: how the reference drove.
        candidate: how the candidate drove.
    """

    test: ComparedTest
    simulator: str
    reference: DriveOutcome
    candidate: DriveOutcome

    @property
    def change(self) -> Change:
        """What became of the test."""
        return CHANGES[self.reference.outcome.is_failure, self.candidate.outcome.is_failure]

    @property
    def margin_change(self) -> float:
        """Change of the smallest lateral distance, m; negative where the candidate comes nearer to the lane's edge."""
        return self.candidate.fitness - self.reference.fitness
