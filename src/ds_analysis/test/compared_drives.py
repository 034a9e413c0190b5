# SPDX-License-Identifier: Apache-2.0
"""Made-up drives of two networks, which tests of comparisons share."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import cache

import numpy as np

from ds_analysis.comparison.paired_drives import ComparedTest, DriveOutcome, Network, PairedDrive
from ds_driver.networks.driver_name import DriverName
from ds_road import Road, generate
from ds_sim import SimulatorName
from ds_sim.scenario import Scenario
from ds_sim.simulator import Outcome


@cache
def road(number: int) -> Road:
    """A random road, which is no mutant of another one."""
    return generate(np.random.default_rng(number))


OLD, NEW = Network(driver=DriverName("old"), sha256="a" * 64), Network(driver=DriverName("new"), sha256="b" * 64)


def outcome(failed: bool, *, key: str = "", fitness: float | None = None) -> DriveOutcome:
    return DriveOutcome(
        outcome=Outcome.OUT_OF_BOUNDS if failed else Outcome.COMPLETED,
        fitness=(-0.2 if failed else 0.5) if fitness is None else fitness,
        trajectory_sha256=hashlib.sha256(key.encode()).hexdigest() if key else "",
        path=np.array([[125.0, 25.0], [125.0, 60.0]]),
    )


def pairs(
    simulator: str, counts: tuple[int, int, int, int], *, unsearched: Sequence[int] = (), first: int = 0
) -> list[PairedDrive]:
    """Drives with so many newly failing, fixed, failing and passing tests; the tests at some places are unsearched."""
    kinds = [(False, True), (True, False), (True, True), (False, False)]
    changes = [kind for kind, number in zip(kinds, counts, strict=True) for _ in range(number)]
    return [
        PairedDrive(
            test=ComparedTest(
                name=f"test-0-{first + number:04d}",
                scenario=Scenario(road(number), seed=number),
                cell=(number % 2, 10),
                unsearched=number in unsearched,
            ),
            simulator=SimulatorName(simulator),
            reference=outcome(before),
            candidate=outcome(after),
        )
        for number, (before, after) in enumerate(changes)
    ]
