# SPDX-License-Identifier: Apache-2.0
"""First screen of a campaign's report: where the driver fails, which sibling to believe, what to do next."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ds_analysis.common.selection import ALPHA, p_of_leads
from ds_analysis.common.statistics import families_of
from ds_base.words import count, listed
from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.folder import CampaignData
from ds_orchestrator.campaign.template import SIZES
from ds_orchestrator.store.model import Test
from ds_report.camera_pictures import worst_first
from ds_report.findings import NOTHING_DRIVEN, road_outcomes, where_it_fails
from ds_sim.registry import SimulatorName

WINDING = (200, 360)
"""Smallest and largest maximum angle of hard roads, degrees; chosen: the upper half of what `generate` can turn."""
GENTLE = (20, 60)
"""The same of gentle roads; chosen: 60 is the tutorial's, whose bends are wider than 20 m."""
NO_TWIN = "none"
"""In the place of the twin, for `ds test --sims`."""


@dataclass(frozen=True, kw_only=True)
class FirstScreen:
    """Where the driver fails, which sibling to believe, what to do next, and the test whose replay is shown, or ""."""

    where: str
    believe: str
    next: str
    command: str
    worst: str = ""


def first_screen(data: CampaignData, folder: str = ".", where: str = "") -> FirstScreen:
    """Answer a user's three questions from a campaign, finished or not; `where` is computed if it is not given."""
    step, command = _next_step(data, folder)
    if not where:
        where = where_it_fails(data.config.driver, road_outcomes(data)) if data.executions else NOTHING_DRIVEN
    data = data.distinct
    failed = data.failed
    return FirstScreen(
        where=where,
        believe=_believe(data, failed),
        next=step,
        command=command,
        worst=next(iter(worst_first(data.tests, data.verdicts)), ""),
    )


Failures = Mapping[tuple[str, SimulatorName], bool]
"""Test and simulator -> whether the driver failed; only verdicts."""


def _believe(data: CampaignData, failed: Failures) -> str:
    """State where siblings disagree, and which to believe: those that agree with the twin more often than by chance."""
    siblings, twin = data.config.siblings, data.config.twin
    tests = [test for test in data.tests if all((test.test_id, name) in failed for name in siblings)]
    if not tests:
        return ""
    split = [test for test in tests if len({failed[test.test_id, name] for name in siblings}) > 1]
    judged = [test for test in split or tests if twin and (test.test_id, twin) in failed]
    if not split:
        return _of_agreement(siblings, twin, tests, judged, failed)
    disagree = f"The siblings {listed(siblings)} disagree on {len(split)} of {count(len(tests), 'test')}"
    if not judged or not twin:
        return f"{disagree}; only drives on a twin or on your car can say which to believe."
    right = np.array([[failed[t.test_id, name] == failed[t.test_id, twin] for t in judged] for name in siblings])
    p = p_of_leads(np.where(right, 1.0, -1.0), families_of([test.road for test in judged]))
    believed = [name for name, chance in zip(siblings, p, strict=True) if chance <= ALPHA]
    shares = listed([f"with {name} in {of.sum()}" for name, of in zip(siblings, right, strict=True)])
    of = f"of {len(judged)} of them that it drove" if len(judged) < len(split) else "there"
    verdict = (
        f"where it has not driven, believe {listed(believed)}"
        if believed
        else f"too few or too mixed to say which to believe: trust {'neither' if len(siblings) == 2 else 'none'} alone"
    )
    return f"{disagree}; {of} the twin {twin} agrees {shares}: {verdict}."


def _of_agreement(
    siblings: Sequence[SimulatorName],
    twin: SimulatorName | None,
    tests: Sequence[Test],
    judged: Sequence[Test],
    failed: Failures,
) -> str:
    """Say what the outcomes of siblings that never disagree, or of one alone, are worth."""
    alone, who = len(siblings) == 1, siblings[0] if len(siblings) == 1 else "they"
    start = "" if alone else f"The siblings {listed(siblings)} agree on {_all_of(len(tests))}: "
    outcomes = [(failed[test.test_id, siblings[0]], failed[test.test_id, twin]) for test in judged if twin]
    if not outcomes:
        lost = sum(failed[test.test_id, siblings[0]] for test in tests)
        did = f"{who} failed {lost or 'none'} of {count(len(tests), 'test')}"
        return f"{start}{did}; only drives on a twin or on your car can say what that is worth."
    own, theirs, both = (sum(of) for of in zip(*((a, b, a and b) for a, b in outcomes), strict=True))
    did = f"failed {own} of {count(len(judged), 'test')}" if own else f"completed {_all_of(len(judged))}"
    if not theirs:
        return f"{start}{who} {did}, and the twin {twin} failed none."
    failures = f"{count(theirs, 'failure')} that the twin {twin} found"
    if not both:
        return f"{start}{who} {did} and missed every one of the {failures}."
    missed = f"missed {theirs - both or 'none'} of the {failures}"
    return f"{start}{who} {did}, of which the twin fails {'all' if both == own else both}, and {missed}."


def _next_step(data: CampaignData, folder: str) -> tuple[str, str]:
    """What to do now and the command for it: finish, other tests, drives of a car, or training on the failures."""
    config = data.config
    missing = config.executions_at_most - len(data.failed) - len(data.excluded)
    if not data.failed or (missing and not config.elites_only):
        return "The campaign is not finished: go on with it.", shlex.join(("ds", "campaign", "resume", folder))
    if proposed := proposal({name: count for name, count in data.failures.items() if count.tests}, config):
        return proposed
    if config.twin is None:
        return "Drive on your car the tests that tell most about it.", shlex.join(("ds", "real", "propose", folder))
    return (
        "Train it on the roads on which it failed, and test it again on new ones. This writes those roads:",
        shlex.join(("ds", "campaign", "roads", folder, "--failed", "--out", "failures.json")),
    )


def proposal(tally: Mapping[str, tuple[int, int]], config: CampaignConfig) -> tuple[str, str] | None:
    """Propose other tests, and the command, by failures and tests of each simulator; None unless all end alike."""
    failures, tests = (sum(column) for column in zip(*tally.values(), strict=True)) if tally else (0, 0)
    where = ", ".join(name for name, (_, of) in tally.items() if of)
    search = config.search
    if not tests or 0 < failures < tests:
        return None
    if not failures:
        passed = f"All {tests} drives on {where} pass, so they show no limit of {config.driver}"
        if search.min_angle < WINDING[0]:
            return (f"{passed}: test more winding roads.", _campaign("harder", config, WINDING))
        return (
            f"{passed}, even on winding roads: find the conditions that break it.",
            f"ds sensitivity --driver {shlex.quote(str(config.driver))} "
            f"--sims {shlex.quote(','.join(config.simulators))} --out sensitivity",
        )
    failed = (
        f"All {tests} drives on {where} fail, so they do not show what {config.driver} can do. If `ds check` finds it "
        "connected correctly"
    )
    if search.conditions or not config.conditions.is_default:
        angles = (search.min_angle, search.max_angle)
        return (f"{failed}, leave out the conditions.", _campaign("gentler", config, angles))
    if search.max_angle > GENTLE[1]:
        return (f"{failed}, test gentler roads.", _campaign("gentler", config, GENTLE))
    return (
        f"{failed}, look at one drive, its camera and its commands: even gentle roads are too hard.",
        f"ds drive --sim {shlex.quote(config.siblings[0])} --driver {shlex.quote(str(config.driver))} "
        f"--seed 1 --max-angle {GENTLE[0]}",
    )


def _campaign(name: str, config: CampaignConfig, angles: tuple[int, int]) -> str:
    """The command that runs a campaign like the given one, but for its roads and conditions."""
    own = (config.search.population, config.search.iterations, config.search.runs)
    size = next((n for n, s in SIZES.items() if (s.population, s.iterations, s.runs) == own), "small")
    names = [*config.siblings, config.twin or NO_TWIN] if len(config.siblings) > 1 else config.simulators
    return (
        f"ds test {shlex.quote(str(config.driver))} --sims {shlex.quote(','.join(names))} "
        f"--size {size} --min-angle {angles[0]} --max-angle {angles[1]} --out {name}"
    )


def _all_of(tests: int) -> str:
    return "the only test" if tests == 1 else f"all {tests} tests"
