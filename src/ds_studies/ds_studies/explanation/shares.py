# SPDX-License-Identifier: Apache-2.0
"""Shares of the parts in which a failing and a completing simulator differ: Shapley values over all exchanges.

What is shared out is the loss of a drive: the share of the half lane that it uses at most, and 1 if it fails in any
way. It was preferred to the outcome (0 or 1) before anything was measured: an outcome is one bit, so that a part that
takes a drive to within a hand's breadth of the edge looks as innocent as one that does nothing, and many failures would
end in a tie. It ends at the edge, since how far a car goes after it has left its lane says nothing about the cause.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, combinations
from typing import Any

from ds_base.table import Column, Table, styled
from ds_base.words import listed
from ds_orchestrator.store.model import Execution
from ds_sim.registry import SimulatorName, label_of

Subset = frozenset[str]
CONDITIONS = "conditions"
"""The test's conditions, exchanged for the default ones, beside the parts of simulators."""
NAMED = 0.6
"""Share that the parts named as the cause have together; chosen: clearly more than half."""
INNOCENT = 0.1
"""Share up to which a part is said not to be the cause; chosen: a fifth of an equal share of two."""


def subsets(parts: Sequence[str]) -> list[Subset]:
    """All subsets, the smaller ones first."""
    return [frozenset(s) for s in chain.from_iterable(combinations(parts, n) for n in range(len(parts) + 1))]


def shapley(parts: Sequence[str], value: Mapping[Subset, float]) -> dict[str, float]:
    """Shapley value of every part, from the value of every subset of the parts (Shapley 1953).

    It is what a part adds to those before it, in the mean over all orders.

    Examples:
        >>> both_needed = {s: float(len(s) == 2) for s in subsets(("camera", "look"))}
        >>> shapley(("camera", "look"), both_needed)
        {'camera': 0.5, 'look': 0.5}
    """
    n = len(parts)
    shares = {}
    for part in parts:
        others = subsets([other for other in parts if other != part])
        weights = [math.factorial(len(s)) * math.factorial(n - 1 - len(s)) / math.factorial(n) for s in others]
        shares[part] = math.fsum(w * (value[s | {part}] - value[s]) for w, s in zip(weights, others, strict=True))
    return shares


def loss_of(execution: Execution, half_lane: float) -> float:
    """Share of the half lane that a drive uses at most; 1 for every failure, less for every other drive."""
    below = math.nextafter(1.0, 0.0)
    return 1.0 if execution.outcome.is_failure else min(execution.max_lateral_position / half_lane, below)


@dataclass(frozen=True, kw_only=True)
class Explanation:
    """Why a test fails on one simulator and not on another.

    Attributes:
        against: simulator on which it completes, which gives the parts for the exchange.
        losses: loss of the drive in which a subset of the parts is that of `fails`, and all others of `against`; for
            each subset of the parts in which the two differ. A drive with the loss 1 fails.
    """

    test_id: str
    fails: SimulatorName
    against: SimulatorName
    losses: Mapping[Subset, float]

    @property
    def repeats(self) -> bool:
        """Whether the exchange of all parts, and that of none, end as the campaign's drives did."""
        return self.losses[max(self.losses, key=len)] == 1.0 > self.losses[frozenset()]

    @property
    def shares(self) -> dict[str, float]:
        """Part -> share of the failure, the largest first; their sum is 1, and there are none unless it repeats."""
        if not self.repeats:
            return {}
        values = shapley([part for subset in self.losses if len(subset) == 1 for part in subset], self.losses)
        return {
            part: values[part] / (1.0 - self.losses[frozenset()]) for part in sorted(values, key=lambda p: -values[p])
        }

    def brings(self, part: str) -> bool:
        """Whether this part of `fails` alone makes the drive on `against` fail."""
        return self.losses[frozenset((part,))] == 1.0

    def cures(self, part: str) -> bool:
        """Whether this part of `against` alone makes the drive on `fails` complete."""
        return self.losses[max(self.losses, key=len) - {part}] < 1.0

    def document(self) -> dict[str, Any]:
        """Convert to JSON values; a drive is named by the parts that are those of `fails`."""
        drives = [
            {"parts": sorted(subset), "loss": loss, "failed": loss == 1.0} for subset, loss in self.losses.items()
        ]
        return {
            "test_id": self.test_id,
            "fails": self.fails,
            "against": self.against,
            "sentence": self.sentence,
            "shares": self.shares,
            "drives": drives,
        }

    def table(self) -> Table:
        """Tabulate the parts, the largest share first."""
        end = {True: "fails", False: "completes"}
        return Table(
            name=f"explanation_{self.test_id}_{label_of(self.fails)}",
            title=f"{self.test_id}: fails on {self.fails}, not on {self.against} ({len(self.losses)} drives)",
            columns=[
                Column("part"),
                Column("share", "number"),
                *styled("text", f"alone on {self.against}", f"{self.fails} without it"),
            ],
            rows=[(p, share, end[self.brings(p)], end[not self.cures(p)]) for p, share in self.shares.items()],
        )

    @property
    def sentence(self) -> str:
        """The cause in words."""
        if not self.repeats:
            return (
                f"{self.test_id}: the drives do not repeat, which fail on {self.fails} and complete on {self.against} "
                "in the campaign: its code, network or car has changed, or a simulator is more than its parts."
            )
        shares, named = self.shares, list[str]()
        for part in shares:
            if sum(shares[one] for one in named) < NAMED:
                named.append(part)
        words = {part: f"the {part} ({share:.2f})" for part, share in shares.items()}
        partly = [words[part] for part in shares if part not in named and shares[part] > INNOCENT]
        innocent = [part for part in shares if part not in named and abs(shares[part]) <= INNOCENT]
        because = listed([words[part] for part in named])
        because += f", partly {listed(partly)}" if partly else ""
        because += f", not the {listed(innocent, 'or')}" if innocent else ""
        cures = [
            f"default {CONDITIONS}" if part == CONDITIONS else f"the {part} of {self.against}"
            for part in filter(self.cures, shares)
        ]
        cured = (
            f"With {listed(cures, 'or')} alone it completes there."
            if cures
            else (f"No single part of {self.against} makes it complete there.")
        )
        return f"{self.test_id} fails on {self.fails} because of {because}. {cured}"
