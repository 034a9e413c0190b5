"""Outcomes as JUnit XML, which GitHub, GitLab, Jenkins and others show as tests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from itertools import groupby
from typing import Literal

from junitparser import Error, Failure, JUnitXml, Skipped, TestCase, TestSuite

from ds_analysis.comparison.analysis import Comparison
from ds_orchestrator.campaign.folder import CampaignData

State = Literal["passed", "failed", "known failure", "error"]


@dataclass(frozen=True, kw_only=True)
class Case:
    """One test on one simulator.

    Attributes:
        test: name of the test.
        simulator: name of the simulator.
        state: `known failure` where the reference fails, too; it is reported as skipped.
        seconds: simulated time driven, s.
        message: what happened, in one line.
    """

    test: str
    simulator: str
    state: State
    seconds: float = 0.0
    message: str = ""


def cases_of(comparison: Comparison) -> list[Case]:
    """Cases of a comparison, by simulator and test: a test that newly fails has failed."""
    states: dict[str, State] = {"newly fails": "failed", "fails in both": "known failure"}
    found = [
        Case(
            test=drive.test.name,
            simulator=drive.simulator,
            state=states.get(drive.change, "passed"),
            seconds=drive.candidate.simulated_seconds,
            message=f"{_words(drive.candidate.outcome.name)}, {_margin(drive.candidate.fitness)}; "
            f"{comparison.reference.driver}: {_words(drive.reference.outcome.name)}",
        )
        for drive in comparison.drives
    ]
    found += [
        Case(test=test, simulator=simulator, state="error", message=reason)
        for test, simulator, reason in comparison.left_out
    ]
    return sorted(found, key=lambda case: (case.simulator, case.test))


def cases_of_campaign(data: CampaignData) -> list[Case]:
    """Cases of a campaign, by simulator and test: a failure of the driver has failed."""
    found = [
        Case(
            test=one.test_id,
            simulator=one.simulator,
            state="failed" if one.outcome.is_failure else "passed",
            seconds=one.simulated_seconds,
            message=f"{_words(one.outcome.name)}, {_margin(one.fitness)}",
        )
        for one in data.verdicts
    ]
    done = {(one.test_id, one.simulator) for one in data.executions}
    errors = {(test, sim): f"{_words(outcome)}: {text}" for test, sim, _, outcome, text in data.errors}
    found += [
        Case(test=test, simulator=sim, state="error", message=text)
        for (test, sim), text in errors.items()
        if (test, sim) not in done
    ]
    return sorted(found, key=lambda case: (case.simulator, case.test))


def junit_of(name: str, cases: Sequence[Case]) -> str:
    """Format cases as JUnit XML, one test suite for each simulator.

    Times are simulated, so that the same outcomes give the same bytes.

    Args:
        name: name of the whole.
        cases: sorted by simulator.
    """
    document = JUnitXml(_clean(name))
    for simulator, group in groupby(cases, key=lambda case: case.simulator):
        suite = TestSuite(_clean(simulator))
        suite.add_testcases([_entry(case) for case in group])
        document.add_testsuite(suite)
    document.update_statistics()
    file = BytesIO()
    document.write(file, pretty=True)
    return file.getvalue().decode()


def _entry(case: Case) -> TestCase:
    entry = TestCase(_clean(case.test), _clean(case.simulator), round(case.seconds, 3))
    kind = {"failed": Failure, "error": Error, "known failure": Skipped}.get(case.state)
    entry.result = [kind(_clean(f"{case.state}: {case.message}"))] if kind else []
    return entry


def _clean(text: str) -> str:
    """Text without the control characters that XML 1.0 does not allow."""
    return "".join(character if character.isprintable() else "?" for character in " ".join(text.split()))


def _margin(fitness: float) -> str:
    return f"{fitness:.2f} m inside its lane" if fitness >= 0.0 else f"{-fitness:.2f} m out of its lane"


def _words(outcome: str) -> str:
    return outcome.lower().replace("_", " ")
