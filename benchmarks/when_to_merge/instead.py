# SPDX-License-Identifier: Apache-2.0
"""What to use instead of the product, computed after part A's outcomes were known, so it is no test of anything.

`python -m benchmarks.when_to_merge.instead` prints the product's gain in both kinds of cases, and r of four choices.
"""

from __future__ import annotations

import numpy as np
from benchmarks.when_to_merge import plan
from benchmarks.when_to_merge.analysis import KEYS_A, Case, cases_of, choose, estimate, load


def r_of_choices(case: Case, rng: np.random.Generator) -> dict[str, float]:
    """Correlate what one could use with the twin's map; the sibling of ten drives follows from the rule's choice."""
    r, rule = case.r, choose(case, rng)
    of_rule = r["product"] + rule["product"]
    return {
        "the product": r["product"],
        "the mean of both maps": r["mean"],
        "the sibling of ten drives on the twin": of_rule - rule["better sibling"],
        "the better sibling": max(r["first"], r["second"]),
    }


def main() -> None:
    """Print both tables."""
    cases = cases_of({name: load(name, False, plan.TABLES) for name in plan.DRIVERS}, KEYS_A, plan.RESAMPLES)
    networks = list(dict.fromkeys(case.network for case in cases))
    for both_harder in (True, False):
        of_kind = [case for case in cases if case.both_harder == both_harder]
        ends = np.array([np.nanquantile(case.gain[1:], [0.025, 0.975]) for case in of_kind])
        gains = [[case.gain for case in of_kind if case.network == name] for name in networks]
        mean = estimate([np.nanmean(of, axis=0) for of in gains if of])
        intervals = f"{(ends[:, 0] > 0).sum()} intervals above 0, {(ends[:, 1] < 0).sum()} below"
        print(f"both fail more often: {both_harder}, {len(of_kind)} cases, gain {mean}; {intervals}")
    rng = np.random.default_rng(plan.SEED)
    choices = {name: [r_of_choices(case, rng) for case in cases if case.network == name] for name in networks}
    for what in next(iter(choices.values()))[0]:
        print(f"{what}: {np.mean([np.mean([one[what] for one in of]) for of in choices.values()]):.2f}")


if __name__ == "__main__":
    main()
