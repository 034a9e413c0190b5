# SPDX-License-Identifier: Apache-2.0
"""Tests that two networks drove on the same simulators: outcomes, counts, exact test, interval, multiplicity."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import count
from typing import Literal

import numpy as np

from ds_analysis.common.selection import ALPHA, p_of_difference
from ds_analysis.common.statistics import Array, are_alone, families_of
from ds_base.errors import InputError
from ds_driver.networks.driver_name import DriverName
from ds_orchestrator.maps.algebra import DRAWS
from ds_orchestrator.search.features import Cell
from ds_orchestrator.store.model import Execution
from ds_sim.registry import SimulatorName
from ds_sim.scenario import Scenario
from ds_sim.simulator import Outcome

Change = Literal["newly fails", "fixed", "fails in both", "passes in both"]
CHANGES: Mapping[tuple[bool, bool], Change] = {
    (False, True): "newly fails",
    (True, False): "fixed",
    (True, True): "fails in both",
    (False, False): "passes in both",
}
"""Whether the reference and the candidate fail -> the change."""


class ComparisonError(InputError):
    """Networks, campaigns or suites that cannot be compared."""


@dataclass(frozen=True, kw_only=True)
class Network:
    """One side of a comparison; the digest of its files is "" for the autopilot, or if it is not known."""

    driver: DriverName
    sha256: str = ""

    @property
    def label(self) -> str:
        """Name with the first digits of the digest."""
        return f"{self.driver} ({self.sha256[:8]})" if self.sha256 else str(self.driver)

    def document(self) -> dict[str, str]:
        """As JSON value."""
        return {"driver": str(self.driver), "sha256": self.sha256}


@dataclass(frozen=True, kw_only=True)
class ComparedTest:
    """Test that both networks drive.

    Attributes:
        name: unique in the comparison, and safe within a file name.
        scenario: None if it is not known.
        unsearched: chosen without looking at any network's outcome, such as a random road.
    """

    name: str
    scenario: Scenario | None
    cell: Cell | None = None
    unsearched: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class DriveOutcome:
    """How one network drove a test on one simulator.

    Attributes:
        fitness: smallest lateral distance, m; below 0 out of the lane; None where only the verdict is known.
        path: (n, 2) positions, m; empty if they are not known.
    """

    outcome: Outcome
    fitness: float | None
    trajectory_sha256: str = ""
    simulated_seconds: float = 0.0
    path: Array = field(default_factory=lambda: np.empty((0, 2)))

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
    """One test on one simulator, driven by both networks."""

    test: ComparedTest
    simulator: SimulatorName
    reference: DriveOutcome
    candidate: DriveOutcome

    @property
    def change(self) -> Change:
        """What became of the test."""
        return CHANGES[self.reference.outcome.is_failure, self.candidate.outcome.is_failure]

    @property
    def margin_change(self) -> float:
        """Change of the smallest lateral distance, m; negative is nearer to the lane's edge; 0 if one is not known."""
        if self.candidate.fitness is None or self.reference.fitness is None:
            return 0.0
        return self.candidate.fitness - self.reference.fitness


TOLERANCE = 0.1
"""Increase of the failure probability below which a candidate is not worse for `ds compare --stop-early`; chosen."""
_STAKES = np.array([0.2, 0.5, 0.95])
"""Shares of the capital that a bet may lose; chosen, as any below 1 is valid and some fit any difference."""
_MOST = 1e280
"""Capital that is enough; more would overflow."""
_DIFFERENCES = np.linspace(-1.0, 1.0, 201)
_PRIOR = 0.5
"""Added to each of the four counts: Jeffreys' prior; Agresti and Min add as much (Statistics in Medicine 24, 2005)."""
Correction = Literal["holm", "fdr_bh"]
"""Names as in statsmodels: Holm's step-down procedure, Benjamini and Hochberg's false discovery rate."""


@dataclass(frozen=True, kw_only=True)
class PairedCounts:
    """Number of tests by what both networks did on them.

    Attributes:
        newly_fail: the reference passes, the candidate fails.
        fixed: the reference fails, the candidate passes.
        changes: every test in the order of the drives where these may stop at any time; see `sequential_evidence`.
        p_of_families: p where tests are mutants of each other; see `ds_analysis.common.selection`.

    Examples:
        >>> from ds_analysis import PairedCounts
        >>> counts = PairedCounts(newly_fail=9, fixed=1, both_fail=5, both_pass=35)
        >>> counts.difference, round(counts.p, 3)
        (0.16, 0.021)
    """

    newly_fail: int
    fixed: int
    both_fail: int
    both_pass: int
    changes: tuple[int, ...] | None = None
    p_of_families: float | None = None

    @classmethod
    def of(cls, drives: Iterable[PairedDrive], *, sequential: bool = False) -> PairedCounts:
        """Count drives; `sequential`: p and interval hold although the outcomes decided when the drives ended."""
        drives = list(drives)
        changes = [drive.change for drive in drives]
        counts, signs = Counter(changes), tuple((one == "newly fails") - (one == "fixed") for one in changes)
        families = families_of([drive.test.scenario.road for drive in drives if drive.test.scenario is not None])
        related = len(families) == len(drives) and not are_alone(families)
        return cls(
            newly_fail=counts["newly fails"],
            fixed=counts["fixed"],
            both_fail=counts["fails in both"],
            both_pass=counts["passes in both"],
            changes=signs if sequential else None,
            p_of_families=p_of_difference(np.array(signs, np.float64), families) if related else None,
        )

    @property
    def tests(self) -> int:
        """Number of pairs."""
        return self.newly_fail + self.fixed + self.both_fail + self.both_pass

    @property
    def reference_failures(self) -> int:
        """Tests on which the reference fails."""
        return self.fixed + self.both_fail

    @property
    def candidate_failures(self) -> int:
        """Tests on which the candidate fails."""
        return self.newly_fail + self.both_fail

    @property
    def difference(self) -> float | None:
        """Failure probability of the candidate minus the reference's; None without tests."""
        return (self.newly_fail - self.fixed) / self.tests if self.tests else None

    @property
    def interval(self) -> tuple[float, float] | None:
        """95% interval of the difference; see `difference_interval`."""
        if not self.tests:
            return None
        if self.changes is not None:
            return sequential_evidence(self.changes)[1]
        return difference_interval(self.newly_fail, self.fixed, self.both_fail, self.both_pass)

    @property
    def p(self) -> float:
        """Two-sided p of as many tests that get worse as better, by McNemar's exact test if all are independent."""
        from scipy.stats import binom

        if self.changes is not None:
            return sequential_evidence(self.changes)[0]
        if self.p_of_families is not None:
            return self.p_of_families
        fewer, changes = min(self.newly_fail, self.fixed), self.newly_fail + self.fixed
        return min(1.0, 2.0 * float(binom.cdf(fewer, changes, 0.5)))


@lru_cache(maxsize=4096)
def sequential_evidence(changes: tuple[int, ...]) -> tuple[float, tuple[float, float]]:
    """Return p of no difference, in either direction, and the interval of the difference, both valid at any time.

    For each difference of the failure probabilities a gambler bets on either side of it, with stakes of equal weights;
    a true difference lets his capital ever grow to 1 / `ALPHA` with a probability of at most `ALPHA` (Ville's
    inequality; Waudby-Smith and Ramdas, J. R. Stat. Soc. B 2024), if each test is drawn without regard to those before.
    `changes` are in the order of the drives: 1 newly fails, -1 is fixed, 0 is as before.

    Examples:
        >>> from ds_analysis.comparison.paired_drives import sequential_evidence
        >>> p, (low, high) = sequential_evidence((1, 1, 0, 1, 1, 1, 1, 1, 1, 1))
        >>> p < 0.05, low > 0.0, high > 0.9
        (True, True, True)
    """
    mean = np.clip((_DIFFERENCES + 1.0) / 2.0, 1e-9, 1.0 - 1e-9)
    stakes = np.concatenate((_STAKES[:, None] / mean, -_STAKES[:, None] / (1.0 - mean)))
    capital, highest = np.ones_like(stakes), np.ones(len(mean))
    for change in changes:
        capital = np.minimum(capital * (1.0 + stakes * ((change + 1.0) / 2.0 - mean)), _MOST)
        highest = np.maximum(highest, capital.mean(axis=0))
    none = len(mean) // 2
    kept = _DIFFERENCES[highest < 1.0 / ALPHA]
    observed = float(np.mean(changes)) if changes else 0.0
    low, high = (float(kept[0]), float(kept[-1])) if len(kept) else (observed, observed)
    return float(1.0 / highest[none]), (min(low, observed), max(high, observed))


@lru_cache(maxsize=4096)
def difference_interval(newly_fail: int, fixed: int, both_fail: int, both_pass: int) -> tuple[float, float]:
    """Estimate a 95% interval of the difference of two failure probabilities on the same tests.

    Equal tails over draws from the Dirichlet posterior of the four outcomes under Jeffreys' prior, seeded by the
    counts, and widened to contain the observed difference. Tests count as independent.
    """
    from scipy.stats import dirichlet

    counts = (newly_fail, fixed, both_fail, both_pass)
    draws = dirichlet.rvs([n + _PRIOR for n in counts], size=DRAWS, random_state=np.random.default_rng(list(counts)))
    low, high = np.quantile(draws[:, 0] - draws[:, 1], [ALPHA / 2, 1.0 - ALPHA / 2])
    observed = (newly_fail - fixed) / sum(counts)
    return min(float(low), observed), max(float(high), observed)


def adjusted(p: Sequence[float], correction: Correction) -> list[float]:
    """Adjust p-values of one family for their number.

    Args:
        p: unadjusted p-values, in any order.
        correction: `holm` bounds the probability of any false claim, `fdr_bh` the share of false claims.

    Examples:
        >>> from ds_analysis import adjusted
        >>> adjusted([0.01, 0.04], "holm")
        [0.02, 0.04]
    """
    if not p:
        return []
    order = np.argsort(p)
    ranked, ranks = np.asarray(p, np.float64)[order], np.arange(1, len(p) + 1)
    if correction == "holm":
        adjusted = np.maximum.accumulate(ranked * ranks[::-1])
    else:
        adjusted = np.minimum.accumulate((ranked / (ranks / len(p)))[::-1])[::-1]
    adjusted_p = np.empty_like(adjusted)
    adjusted_p[order] = np.minimum(adjusted, 1.0)
    return [float(value) for value in adjusted_p]


def fewest_changes(family: int, *, sequential: bool = False) -> int:
    """Fewest changes in one direction that Holm's procedure can call significant among so many tests."""

    def p_of(changes: int) -> float:
        order = (1,) * changes if sequential else None
        return PairedCounts(newly_fail=changes, fixed=0, both_fail=0, both_pass=0, changes=order).p

    return next(changes for changes in count(1) if p_of(changes) * max(family, 1) < ALPHA)
