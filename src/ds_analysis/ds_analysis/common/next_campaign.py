# SPDX-License-Identifier: Apache-2.0
"""Proposes what to run after a campaign in which everything passes, or everything fails.

Neither says where the limits of a network are. Rules, fixed before they were applied to any campaign:

1. Everything passes: more winding roads; on winding roads already, find the conditions that break the network.
2. Everything fails: the same roads without conditions if there are any; else gentler roads; on gentle roads already,
   look at one drive.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from typing import NamedTuple

from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.template import SIZES

WINDING = (200, 360)
"""Smallest and largest maximum angle of hard roads, degrees; chosen: the upper half of what `generate` can turn."""
GENTLE = (20, 60)
"""The same of gentle roads; chosen: 60 is the tutorial's, whose bends are wider than 20 m."""
NO_TWIN = "none"
"""In the place of the twin, for `ds test --sims`."""


class Proposal(NamedTuple):
    """What to do next: a sentence, and a command for a shell."""

    sentence: str
    command: str


def proposal(tally: Mapping[str, tuple[int, int]], config: CampaignConfig) -> Proposal | None:
    """Propose harder or gentler tests; None if nothing was driven, or some tests pass and some fail.

    `tally` has failures and tests of a finished campaign for each simulator.
    """
    failures, tests = (sum(column) for column in zip(*tally.values(), strict=True)) if tally else (0, 0)
    where = ", ".join(name for name, (_, of) in tally.items() if of)
    search = config.search
    if not tests or 0 < failures < tests:
        return None
    if not failures:
        passed = f"All {tests} drives on {where} pass, so they show no limit of {config.driver}"
        if search.min_angle < WINDING[0]:
            return Proposal(f"{passed}: test more winding roads.", _campaign("harder", config, WINDING))
        return Proposal(
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
        return Proposal(f"{failed}, leave out the conditions.", _campaign("gentler", config, angles))
    if search.max_angle > GENTLE[1]:
        return Proposal(f"{failed}, test gentler roads.", _campaign("gentler", config, GENTLE))
    return Proposal(
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
