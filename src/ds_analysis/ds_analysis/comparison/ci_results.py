# SPDX-License-Identifier: Apache-2.0
"""Pass criteria of a CI job, and outcomes as JUnit XML, which GitHub, GitLab, Jenkins and others show as tests."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Literal
from xml.dom.minidom import parseString
from xml.etree.ElementTree import Element, SubElement, tostring

from ds_analysis.comparison.analysis import Comparison
from ds_orchestrator.campaign.config import ConfigError
from ds_orchestrator.campaign.folder import CampaignData
from ds_sim.registry import SimulatorName
from ds_sim.simulator import Outcome

FailOn = Literal["failure", "regression", "worse"]


@dataclass(frozen=True, kw_only=True)
class MaxFailures:
    """Largest number or share of tests that may fail on each simulator.

    Examples:
        >>> from ds_analysis import MaxFailures
        >>> [MaxFailures.parse(text).allows(failures=1, tests=10) for text in ("5%", "10%", "3")]
        [False, True, True]
    """

    count: int | None = None
    share: float | None = None

    @classmethod
    def parse(cls, text: str) -> MaxFailures:
        """Parse `5%` or `3`; `ConfigError` if it is neither a share from 0 to 100% nor a number of tests."""
        if re.fullmatch(r"\d{1,3}(\.\d{1,6})?%", text) and float(text[:-1]) <= 100.0:
            return cls(share=float(text[:-1]) / 100.0)
        if re.fullmatch(r"\d{1,9}", text):
            return cls(count=int(text))
        raise ConfigError(f"--max-failures {text!r:.40}: expected a share from 0% to 100%, or a number of tests, as 3")

    def allows(self, failures: int, tests: int) -> bool:
        """Whether so many failures are within the limit."""
        return failures <= (self.count if self.count is not None else (self.share or 0.0) * tests)

    def __str__(self) -> str:
        return str(self.count) if self.count is not None else f"{100 * (self.share or 0.0):g}%"


@dataclass(frozen=True, kw_only=True)
class Criteria:
    """Pass criteria.

    Attributes:
        fail_on: `failure`, any test fails; `regression`, any newly fails; `worse`, significantly on some simulator.
    """

    fail_on: FailOn | None = None
    max_failures: MaxFailures | None = None

    def unmet(
        self,
        tally: Mapping[SimulatorName, tuple[int, int]],
        *,
        newly_failing: int | None = None,
        worse: Sequence[str] = (),
    ) -> list[str]:
        """Say which criteria are not met, one sentence each; `newly_failing` is None without a reference.

        `ConfigError` if a criterion needs one.
        """
        self.check(has_reference=newly_failing is not None)
        unmet = []
        failing = {name: failures for name, (failures, _) in tally.items() if failures}
        if self.fail_on == "failure" and failing:
            unmet.append("tests fail: " + ", ".join(f"{n} on {name}" for name, n in failing.items()))
        if self.fail_on == "regression" and newly_failing:
            unmet.append(f"{newly_failing} {'drive newly fails' if newly_failing == 1 else 'drives newly fail'}")
        if self.fail_on == "worse" and worse:
            unmet.append(f"significantly worse on {', '.join(worse)}")
        if self.max_failures is not None:
            unmet += [
                f"{failures} of {tests} tests fail on {name}, expected {self.max_failures} at most"
                for name, (failures, tests) in tally.items()
                if not self.max_failures.allows(failures, tests)
            ]
        return unmet

    def check(self, *, has_reference: bool) -> None:
        """Refuse, by a `ConfigError`, a criterion that needs a comparison where there is none."""
        if self.fail_on in ("regression", "worse") and not has_reference:
            raise ConfigError(
                f"--fail-on {self.fail_on} needs outcomes to compare with: use it with `ds compare` or "
                "`ds suite run`, or choose --fail-on failure"
            )


State = Literal["passed", "failed", "known failure", "error"]


@dataclass(frozen=True, kw_only=True)
class Case:
    """One test on one simulator, its simulated seconds; a `known failure` is one of the reference, too."""

    test: str
    simulator: SimulatorName
    state: State
    seconds: float = 0.0
    message: str = ""


def cases_of(comparison: Comparison) -> list[Case]:
    """Cases of a comparison, by simulator and test: a test that newly fails has failed."""
    states: dict[str, State] = {"newly fails": "failed", "fails in both": "known failure"}
    cases = [
        Case(
            test=drive.test.name,
            simulator=drive.simulator,
            state=states.get(drive.change, "passed"),
            seconds=drive.candidate.simulated_seconds,
            message=f"{drive.candidate.outcome.words}, {_margin(drive.candidate.fitness)}; "
            f"{comparison.reference.driver}: {drive.reference.outcome.words}",
        )
        for drive in comparison.drives
    ]
    cases += [
        Case(test=test, simulator=simulator, state="error", message=reason)
        for test, simulator, reason in comparison.left_out
    ]
    return sorted(cases, key=lambda case: (case.simulator, case.test))


def cases_of_campaign(data: CampaignData) -> list[Case]:
    """Cases of a campaign, by simulator and test: a failure of the driver has failed."""
    cases = [
        Case(
            test=one.test_id,
            simulator=one.simulator,
            state="failed" if one.outcome.is_failure else "passed",
            seconds=one.simulated_seconds,
            message=f"{one.outcome.words}, {_margin(one.fitness)}",
        )
        for one in data.verdicts
    ]
    done = {(one.test_id, one.simulator) for one in data.executions}
    errors = {(test, sim): f"{Outcome[outcome].words}: {text}" for test, sim, _, outcome, text in data.errors}
    cases += [
        Case(test=test, simulator=sim, state="error", message=text)
        for (test, sim), text in errors.items()
        if (test, sim) not in done
    ]
    return sorted(cases, key=lambda case: (case.simulator, case.test))


def junit_of(name: str, cases: Sequence[Case]) -> str:
    """Format cases, sorted by simulator, as JUnit XML, one test suite for each simulator."""
    document = Element("testsuites", _totals(name, cases, ("failures", "errors", "skipped")))
    for simulator, group in groupby(cases, key=lambda case: case.simulator):
        tests = list(group)
        suite = SubElement(document, "testsuite", _totals(simulator, tests, ("errors", "failures", "skipped")))
        for case in tests:
            about = {"name": _clean(case.test), "classname": _clean(case.simulator), "time": str(_seconds([case]))}
            entry = SubElement(suite, "testcase", about)
            if case.state in _ELEMENTS:
                SubElement(entry, _ELEMENTS[case.state][0], message=_clean(f"{case.state}: {case.message}"))
    return parseString(tostring(document)).toprettyxml(encoding="utf-8").decode()


_ELEMENTS = {"failed": ("failure", "failures"), "error": ("error", "errors"), "known failure": ("skipped", "skipped")}
"""State -> element of JUnit XML, and the attribute that counts it."""


def _totals(name: str, cases: Sequence[Case], counts: Sequence[str]) -> dict[str, str]:
    kinds = Counter(_ELEMENTS[case.state][1] for case in cases if case.state in _ELEMENTS)
    numbers = {kind: str(kinds[kind]) for kind in counts}
    return {"name": _clean(name), "tests": str(len(cases)), **numbers, "time": str(_seconds(cases))}


def _seconds(cases: Sequence[Case]) -> float:
    return round(sum(round(case.seconds, 3) for case in cases), 3)


def _clean(text: str) -> str:
    """Text without the control characters that XML 1.0 does not allow."""
    return "".join(character if character.isprintable() else "?" for character in " ".join(text.split()))


def _margin(fitness: float | None) -> str:
    if fitness is None:
        return "by its verdict"
    return f"{fitness:.2f} m inside its lane" if fitness >= 0.0 else f"{-fitness:.2f} m out of its lane"
