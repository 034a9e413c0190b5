"""Says in a few sentences whether a candidate should replace the reference."""

from __future__ import annotations

import math
from typing import Literal

from ds_analysis.common.paired_statistics import fewest_changes
from ds_analysis.comparison.analysis import Comparison, SimulatorComparison

Advice = Literal["merge", "look first", "do not merge", "not decided"]


def advice_of(comparison: Comparison) -> Advice:
    """Advise by rules that were fixed before any comparison.

    - `do not merge`: the candidate is significantly worse on some simulator.
    - `look first`: some test newly fails.
    - `not decided`: drives are missing, or the reference passes so few tests on some simulator that a candidate which
      failed all of them could not be called worse.
    - `merge`: none of these.
    """
    if any(row.verdict == "worse" for row in comparison.simulators):
        return "do not merge"
    if comparison.newly_failing:
        return "look first"
    return "not decided" if comparison.left_out or _too_few(comparison) else "merge"


def answer_of(comparison: Comparison) -> str:
    """Answer the question whether to merge, in one sentence."""
    advice, newly = advice_of(comparison), len(comparison.newly_failing)
    if advice == "do not merge":
        return "Merge? No: it is worse."
    if advice == "look first":
        return f"Merge? Look first: {count(newly, 'drive')} newly {'fails' if newly == 1 else 'fail'}."
    if advice == "not decided":
        missing = "drives are missing" if comparison.left_out else "too few tests to tell, though none newly fails"
        return f"Merge? Not decided: {missing}."
    if comparison.is_identical:
        return "Merge? Nothing changes: every drive is the same."
    worst = max(row.counts.interval[1] for row in comparison.simulators if row.counts.interval)
    return (
        "Merge? Nothing speaks against it: no drive newly fails; "
        f"at most {math.ceil(100 * worst)} more failures in 100 such tests are compatible with that."
    )


def _too_few(comparison: Comparison) -> bool:
    needed = fewest_changes(family_of(comparison))
    passed = [row.counts.newly_fail + row.counts.both_pass for row in comparison.simulators]
    return not comparison.is_identical and any(number < needed for number in passed)


def family_of(comparison: Comparison) -> int:
    """Number of p-values from which verdicts are made."""
    families = [row.counts for row in comparison.simulators]
    if comparison.origin in ("reference", "suite"):
        families += [row.unsearched for row in comparison.simulators]
    return sum(counts.tests > 0 for counts in families)


def sentences_of(comparison: Comparison) -> list[str]:
    """Give the reasons, the most important first."""
    if not comparison.drives:
        return ["No test has a verdict of both networks, so nothing was compared."]
    if comparison.is_identical:
        return [
            f"Both networks drove all {count(len(comparison.drives), 'pair')} identically, to the bit."
            + (" They are the same files." if comparison.reference.sha256 == comparison.candidate.sha256 else "")
        ]
    order = {"worse": 0, "better": 1, "not significant": 2}
    rows = sorted(comparison.simulators, key=lambda row: order[row.verdict])
    found = [_sentence(row, comparison) for row in rows if row.counts.tests]
    found += [f"{count(len(comparison.left_out), 'pair')} left out: a drive ended in an error."] * bool(
        comparison.left_out
    )
    return found


def cautions_of(comparison: Comparison) -> list[str]:
    """Say what the numbers cannot carry."""
    if comparison.is_identical:
        return []
    found = _of_selection(comparison)
    if comparison.origin != "random":
        found.append("Tests of a search resemble each other, so p and intervals are too optimistic.")
    family = family_of(comparison)
    needed = fewest_changes(family)
    changed = max((row.counts.newly_fail + row.counts.fixed for row in comparison.simulators), default=0)
    if changed < needed:
        found.append(
            f"Too few tests change for a conclusion: {changed} at most on one simulator; with "
            f"{count(family, 'comparison')}, a significant difference needs {needed} in the same direction."
        )
    return found


def _of_selection(comparison: Comparison) -> list[str]:
    """Say what follows from how the tests were chosen."""
    if comparison.origin == "suite":
        return ["The tests of a suite were selected and are no sample: what counts are tests that newly fail."]
    if comparison.origin != "reference":
        return []
    random = max((row.unsearched.tests for row in comparison.simulators), default=0)
    by = (
        f"is judged by the {count(random, 'random road')} among them" if random else "is not claimed, as none is random"
    )
    return [
        f"The tests were searched for failures of {comparison.reference.driver}; a network that is as good fails on "
        "fewer of them. So tests that newly fail are real, but fixed ones are no evidence that the candidate is better:"
        f' "better" {by}.'
    ]


def _sentence(row: SimulatorComparison, comparison: Comparison) -> str:
    where = f"{row.simulator} (twin)" if row.simulator == comparison.twin else row.simulator
    of_random = row.verdict == "better" and comparison.origin == "reference"
    counts = row.unsearched if of_random else row.counts
    tests = count(counts.tests, "random road" if of_random else "test")
    fails, are = ("fails" if counts.newly_fail == 1 else "fail"), ("is" if counts.fixed == 1 else "are")
    changes = f"{counts.newly_fail} of {tests} newly {fails}, {counts.fixed} {are} fixed"
    if row.verdict == "worse":
        return f"Worse on {where}: {changes} (p = {row.p_adjusted:.2g} after Holm)."
    if row.verdict == "better":
        return f"Better on {where}: {changes} (p = {row.unsearched_p_adjusted:.2g} after Holm)."
    assert counts.interval is not None
    low, high = counts.interval
    return (
        f"Not significant on {where}: {changes} (p = {row.p_adjusted:.2g} after Holm); 95 %: {_signed(low)} to "
        f"{_signed(high)} failures in 100 such tests."
    )


def _signed(difference: float) -> str:
    return f"{abs(100 * difference):.0f} {'more' if difference > 0 else 'fewer'}"


def count(number: int, what: str) -> str:
    """Count in words: `1 drive`, `2 drives`."""
    return f"{number} {what}{'' if number == 1 else 's'}"
