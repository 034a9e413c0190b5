# SPDX-License-Identifier: Apache-2.0
"""Progress of a campaign, stage by stage."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ds_base.folder_files import StoreError
from ds_base.intervals import FailureCount
from ds_driver.control.command_habits import Habit, command_habits
from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.folder import STAGES, CampaignData, read_campaign
from ds_orchestrator.maps.campaign_maps import elites_of
from ds_orchestrator.store.store import Store
from ds_sim.registry import SimulatorName


@dataclass(frozen=True, kw_only=True)
class Stage:
    """Progress of one stage.

    Attributes:
        name: `search bullet, run 0`, `migration: bullet to softbody`, `twin: bullet to donkey`, `maps`, ...
        done: executions with a verdict and excluded tests, or 1 for a result that is up to date.
        expected: total when the stage is done; None while it is not known.
        failures: number of executions in which the driver failed; None for a result.
        excluded: number of tests by which no network can be judged there; they are done.
    """

    name: str
    done: int
    expected: int | None
    failures: int | None = None
    excluded: int = 0

    @property
    def state(self) -> str:
        """`done`, `begun` or `to do`."""
        if self.expected is not None and self.done >= self.expected:
            return "done"
        return "begun" if self.done else "to do"


Group = tuple[SimulatorName, int, SimulatorName]
"""Sibling and run of the search that generated tests, and a simulator."""


def stages_of(data: CampaignData) -> list[Stage]:
    """List every stage of a campaign that was read, in the order in which they run."""
    config, of_test = data.config, {test.test_id: test for test in data.tests}
    groups: dict[Group, list[bool]] = {}
    for (test_id, simulator), failed in data.failed.items():
        groups.setdefault((of_test[test_id].sibling, of_test[test_id].run, simulator), []).append(failed)
    searched, migrated = len(of_test) == config.tests, set(of_test)
    if config.elites_only:
        migrated = elites_of(data.tests, data.verdicts, data.cells, ignored=data.given_up)
        decided = {e.test_id for e in data.verdicts if of_test[e.test_id].sibling == e.simulator}
        decided |= {test_id for test_id, simulator in data.excluded if of_test[test_id].sibling == simulator}
        searched = searched and set(of_test) <= decided | data.given_up
    return _stages(
        config,
        drives={group: FailureCount(sum(failed), len(failed)) for group, failed in groups.items()},
        excluded=Counter((of_test[i].sibling, of_test[i].run, simulator) for i, simulator in data.excluded),
        migrating=Counter(of_test[test_id].sibling for test_id in migrated) if searched else None,
        results=data.results,
        result_count=data.result_count,
    )


def stages_of_store(store: Store, config: CampaignConfig) -> list[Stage]:
    """List the same, counted by SQLite where no cell of a test is needed: in memory that no campaign's size decides."""
    if config.elites_only:
        return stages_of(read_campaign(store))
    tests = store.count_tests_by_sibling()
    return _stages(
        config,
        drives=store.failures_of_groups(),
        excluded=store.count_excluded(),
        migrating=tests if sum(tests.values()) == config.tests else None,
        results=store.results(),
        result_count=store.count_results(),
    )


def _stages(
    config: CampaignConfig,
    *,
    drives: Mapping[Group, FailureCount],
    excluded: Mapping[Group, int],
    migrating: Mapping[SimulatorName, int] | None,
    results: Mapping[str, int],
    result_count: int,
) -> list[Stage]:
    """Stages, given failures and exclusions of each group, and how many tests migrate, None while searches run."""
    runs = range(config.search.runs)

    def stage(name: str, groups: Sequence[Group], expected: int | None) -> Stage:
        failures, done = (sum(n) for n in zip(*(drives.get(g, FailureCount(0, 0)) for g in groups), strict=True))
        without = sum(excluded.get(group, 0) for group in groups)
        return Stage(name=name, done=done + without, expected=expected, failures=failures, excluded=without)

    stages = [
        stage(f"search {sibling}, run {run}", [(sibling, run, sibling)], config.settings.budget)
        for sibling in config.siblings
        for run in runs
    ]
    for target in config.simulators:
        role = "twin" if target == config.twin else "migration"
        for origin in config.siblings:
            if origin != target:
                expected = None if migrating is None else migrating.get(origin, 0)
                groups = [(origin, run, target) for run in runs]
                stages.append(stage(f"{role}: {origin} to {target}", groups, expected))
    up_to_date = ((name, results.get(name) == result_count) for name in STAGES)
    return [*stages, *(Stage(name=name, done=int(done), expected=1) for name, done in up_to_date)]


DRIVES_SAMPLED = 24
"""Drives that are decoded to look at a driver's commands; chosen: they take 20 ms, and every drive shows a habit."""


def driver_habits(store: Store) -> tuple[Habit, ...]:
    """Find what is unusual in a campaign's commands, in a bounded sample of its drives; nothing if one is damaged."""
    try:
        drives = [one.drive for one in store.sampled_executions(DRIVES_SAMPLED)]
        steering = [np.empty(0), *(one.steering for one in drives)]
        speeds = [np.empty(0), *(one.trajectory[:, 3] for one in drives)]
    except StoreError:
        return ()  # what reads all drives says so
    return command_habits(np.concatenate(steering), np.concatenate(speeds))


def is_driven(store: Store, config: CampaignConfig) -> bool:
    """Check whether every driving stage is done, so that resuming the campaign needs no graph."""
    return all(one.state == "done" for one in stages_of_store(store, config) if one.failures is not None)
