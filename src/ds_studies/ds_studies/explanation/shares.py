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

from ds_analysis.common.table import Column, Table
from ds_orchestrator.store.model import Execution
from ds_sim.registry import label_of

Subset = frozenset[str]
NAMED = 0.6
"""Share that the parts named as the cause have together; chosen: clearly more than half."""
INNOCENT = 0.1
"""Share up to which a part is said not to be the cause; chosen: a fifth of an equal share of two."""


def subsets(parts: Sequence[str]) -> list[Subset]:
    """All subsets, the smaller ones first."""
    return [frozenset(s) for s in chain.from_iterable(combinations(parts, n) for n in range(len(parts) + 1))]


def shapley(parts: Sequence[str], value: Mapping[Subset, float]) -> dict[str, float]:
    """Shapley value of every part: what it adds to those before it, mean over all orders (Shapley 1953).

    Args:
        parts: players of the game.
        value: of every subset of them.

    Examples:
        >>> both_needed = {s: float(len(s) == 2) for s in subsets(("camera", "look"))}
        >>> shapley(("camera", "look"), both_needed)
        {'camera': 0.5, 'look': 0.5}
    """
    n = len(parts)
    found = {}
    for part in parts:
        others = subsets([other for other in parts if other != part])
        weights = [math.factorial(len(s)) * math.factorial(n - 1 - len(s)) / math.factorial(n) for s in others]
        found[part] = math.fsum(w * (value[s | {part}] - value[s]) for w, s in zip(weights, others, strict=True))
    return found


def loss_of(execution: Execution, half_lane: float) -> float:
    """Share of the half lane that a drive uses at most; 1 for every failure."""
    return 1.0 if execution.outcome.is_failure else min(execution.max_lateral_position / half_lane, 1.0)


@dataclass(frozen=True, kw_only=True)
class Explanation:
    """Why a test fails on one simulator and not on another.

    Attributes:
        test_id: the test.
        fails: simulator on which it fails.
        against: simulator on which it completes, which gives the parts for the exchange.
        parts: parts in which the two differ.
        losses: loss of the drive in which a subset of the parts is that of `fails`, and all others of `against`; for
            each subset.
        failed: subset -> whether that drive fails.
    """

    test_id: str
    fails: str
    against: str
    parts: tuple[str, ...]
    losses: Mapping[Subset, float]
    failed: Mapping[Subset, bool]

    @property
    def repeats(self) -> bool:
        """Whether the exchange of all parts, and that of none, end as the campaign's drives did."""
        return self.failed[frozenset(self.parts)] and not self.failed[frozenset()]

    @property
    def difference(self) -> float:
        """Loss to be shared out: that of a failure over that of the drive without any of its parts; 1 if that fails."""
        return 1.0 - self.losses[frozenset()] or 1.0

    @property
    def shares(self) -> dict[str, float]:
        """Part -> share of the difference, the largest first; what is left to 1 is `left_over`."""
        values = shapley(self.parts, self.losses)
        return {part: values[part] / self.difference for part in sorted(self.parts, key=lambda p: -values[p])}

    @property
    def left_over(self) -> float:
        """Share of the difference that no exchange of parts explains; 0 where the simulators consist of their parts."""
        return (1.0 - self.losses[frozenset(self.parts)]) / self.difference

    @property
    def only_together(self) -> float:
        """Share of the difference that no part brings about alone; negative where parts do the same twice."""
        alone = sum(self.losses[frozenset((part,))] - self.losses[frozenset()] for part in self.parts)
        return 1.0 - alone / self.difference

    @property
    def outcome_shares(self) -> dict[str, float]:
        """Part -> Shapley value of the outcome, 1 for a failure, instead of the loss."""
        return shapley(self.parts, {subset: float(fails) for subset, fails in self.failed.items()})

    def brings(self, part: str) -> bool:
        """Whether this part of `fails` alone makes the drive on `against` fail."""
        return self.failed[frozenset((part,))]

    def cures(self, part: str) -> bool:
        """Whether this part of `against` alone makes the drive on `fails` complete."""
        return not self.failed[frozenset(self.parts) - {part}]

    def document(self) -> dict[str, Any]:
        """Convert to JSON values; a drive is named by the parts that are those of `fails`."""
        return {
            "test_id": self.test_id, "fails": self.fails, "against": self.against, "sentence": self.sentence,
            "shares": self.shares, "left_over": self.left_over, "only_together": self.only_together,
            "outcome_shares": self.outcome_shares,
            "drives": [
                {"parts": sorted(subset), "loss": loss, "failed": self.failed[subset]}
                for subset, loss in self.losses.items()
            ],
        }  # fmt: skip

    def table(self) -> Table:
        """Tabulate the parts of the explanation, the largest share first, then what is left over."""
        columns = [
            Column("part"), Column("share", "number"), Column(f"alone on {self.against}"),
            Column(f"{self.fails} without it"),
        ]  # fmt: skip
        rows = [
            (part, share, "fails" if self.brings(part) else "completes", "completes" if self.cures(part) else "fails")
            for part, share in self.shares.items()
        ]
        return Table(
            name=f"explanation_{self.test_id}_{label_of(self.fails)}",
            title=f"{self.test_id}: fails on {self.fails}, not on {self.against}",
            columns=columns,
            rows=[*rows, ("left over", self.left_over, "", "")],
            notes=[f"{len(self.losses)} drives; {self.only_together:.2f} of the difference comes about only together."],
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
            named.append(part)
            if sum(shares[one] for one in named) >= NAMED:
                break
        innocent = [part for part in shares if part not in named and abs(shares[part]) <= INNOCENT]
        words = {part: f"the {part} ({share:.2f})" for part, share in shares.items()}
        because = _joined([words[part] for part in named], "and")
        partly = [words[part] for part in shares if part not in named and shares[part] > INNOCENT]
        other = f", partly {_joined(partly, 'and')}" if partly else ""
        other += f", not the {_joined(innocent, 'or')}" if innocent else ""
        cured = f"No single part of {self.against} makes it complete there."
        cures = [
            f"default {CONDITIONS}" if part == CONDITIONS else f"the {part} of {self.against}"
            for part in shares
            if self.cures(part)
        ]
        if cures:
            cured = f"With {_joined(cures, 'or')} alone it completes there."
        return f"{self.test_id} fails on {self.fails} because of {because}{other}. {cured}"


CONDITIONS = "conditions"
"""The test's conditions, exchanged for the default ones, beside the parts of simulators."""


def _joined(words: Sequence[str], last: str) -> str:
    """`a`, `a and b`, `a, b and c`."""
    return f" {last} ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)
