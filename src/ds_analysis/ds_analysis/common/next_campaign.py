# SPDX-License-Identifier: Apache-2.0
"""Proposes what to run after a campaign in which everything passes, or everything fails.

Neither says where the limits of a network are. Rules, fixed before they were applied to any campaign:

1. Everything passes: more winding roads, under the conditions that a sensitivity analysis found if there is one; on
   winding roads already, find those conditions first.
2. Everything fails: the same roads without conditions if there are any; else gentler roads; on gentle roads already,
   look at one drive.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass

from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.template import SIZES

WINDING = (200, 360)
"""Smallest and largest maximum angle of hard roads, degrees; chosen: the upper half of what `generate` can turn."""
GENTLE = (20, 60)
"""The same of gentle roads; chosen: 60 is the tutorial's, whose bends are wider than 20 m."""
NO_TWIN = "none"
"""In the place of the twin, for `ds test --sims`."""


@dataclass(frozen=True, kw_only=True)
class Proposal:
    """What to do next.

    Attributes:
        sentence: for a reader, ends with a full stop.
        command: for a shell, does it when pasted.
    """

    sentence: str
    command: str


def proposal(
    tally: Mapping[str, tuple[int, int]],
    config: CampaignConfig,
    sensitivity: str = "",
) -> Proposal | None:
    """Propose harder or gentler tests; None if nothing was driven, or some tests pass and some fail.

    `tally` has failures and tests of a finished campaign for each simulator; `sensitivity` is the folder of `ds
    sensitivity --out` for this network, or "".
    """
    failures, tests = (sum(column) for column in zip(*tally.values(), strict=True)) if tally else (0, 0)
    where = ", ".join(name for name, (_, of) in tally.items() if of)
    search = config.search
    if not tests or 0 < failures < tests:
        return None
    if not failures:
        passed = f"All {tests} drives on {where} pass, so they show no limit of {config.driver}"
        if search.min_angle < WINDING[0] or sensitivity:
            under = f", under the conditions of {sensitivity} that break it" if sensitivity else ""
            return Proposal(
                sentence=f"{passed}: test more winding roads{under}.",
                command=_campaign("harder", config, WINDING, sensitivity),
            )
        return Proposal(
            sentence=f"{passed}, even on winding roads: find the conditions that break it.",
            command=f"ds sensitivity --driver {shlex.quote(str(config.driver))} "
            f"--sims {shlex.quote(','.join(config.simulators))} --out sensitivity",
        )
    failed = (
        f"All {tests} drives on {where} fail, so they do not show what {config.driver} can do. If `ds check` finds it "
        "connected correctly"
    )
    if search.conditions or not config.conditions.is_default:
        angles = (search.min_angle, search.max_angle)
        return Proposal(sentence=f"{failed}, leave out the conditions.", command=_campaign("gentler", config, angles))
    if search.max_angle > GENTLE[1]:
        return Proposal(sentence=f"{failed}, test gentler roads.", command=_campaign("gentler", config, GENTLE))
    return Proposal(
        sentence=f"{failed}, look at one drive, its camera and its commands: even gentle roads are too hard.",
        command=f"ds drive --sim {shlex.quote(config.siblings[0])} --driver {shlex.quote(str(config.driver))} "
        f"--seed 1 --max-angle {GENTLE[0]}",
    )


def _campaign(name: str, config: CampaignConfig, angles: tuple[int, int], sensitivity: str = "") -> str:
    """The command that runs a campaign like the given one, but for its roads and conditions."""
    own = (config.search.population, config.search.iterations, config.search.runs)
    size = next((n for n, s in SIZES.items() if (s.population, s.iterations, s.runs) == own), "small")
    under = f"--sensitivity {shlex.quote(sensitivity)} " if sensitivity else ""
    return " ".join(
        [
            f"ds test {shlex.quote(str(config.driver))} --sims {_simulators(config)}",
            f"--size {size} --min-angle {angles[0]} --max-angle {angles[1]}",
            f"{under}--out {name}",
        ]
    )


def _simulators(config: CampaignConfig) -> str:
    names = [*config.siblings, config.twin or NO_TWIN] if len(config.siblings) > 1 else config.simulators
    return shlex.quote(",".join(names))
