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


@dataclass(frozen=True, kw_only=True)
class Tally:
    """Numbers of a campaign from which its stages follow.

    Attributes:
        config: configuration of the campaign.
        drives: group -> failures among its executions.
        excluded: group -> tests by which no network can be judged there.
        migrating: sibling -> its tests that migrate; None while searches are not done.
        results: result -> number of executions and gates from which it was computed.
        result_count: their present number.
    """

    config: CampaignConfig
    drives: Mapping[Group, FailureCount]
    excluded: Mapping[Group, int]
    migrating: Mapping[SimulatorName, int] | None
    results: Mapping[str, int]
    result_count: int

    @classmethod
    def of(cls, data: CampaignData) -> Tally:
        """Count what was read of a campaign."""
        config, of_test = data.config, {test.test_id: test for test in data.tests}
        groups: dict[Group, list[bool]] = {}
        for (test_id, simulator), failed in data.failed.items():
            groups.setdefault((of_test[test_id].sibling, of_test[test_id].run, simulator), []).append(failed)
        searched, migrated = len(of_test) == _tests_of(config), set(of_test)
        if config.elites_only:
            migrated = elites_of(data.tests, data.verdicts, data.cells, ignored=data.given_up)
            decided = {e.test_id for e in data.verdicts if of_test[e.test_id].sibling == e.simulator}
            decided |= {test_id for test_id, simulator in data.excluded if of_test[test_id].sibling == simulator}
            searched = searched and set(of_test) <= decided | data.given_up
        return cls(
            config=config,
            drives={group: FailureCount(sum(failed), len(failed)) for group, failed in groups.items()},
            excluded=Counter((of_test[i].sibling, of_test[i].run, simulator) for i, simulator in data.excluded),
            migrating=Counter(of_test[test_id].sibling for test_id in migrated) if searched else None,
            results=data.results,
            result_count=data.result_count,
        )

    @classmethod
    def of_store(cls, store: Store, config: CampaignConfig) -> Tally:
        """Let SQLite count, where no cell of a test is needed: the memory taken does not depend on the campaign."""
        if config.elites_only:
            return cls.of(read_campaign(store))
        tests = store.count_tests_by_sibling()
        return cls(
            config=config,
            drives=store.failures_of_groups(),
            excluded=store.count_excluded(),
            migrating=tests if sum(tests.values()) == _tests_of(config) else None,
            results=store.results(),
            result_count=store.count_results(),
        )

    def stages(self) -> list[Stage]:
        """List every stage in the order in which they run."""
        config, runs = self.config, range(self.config.search.runs)
        stages = [
            self._stage(f"search {sibling}, run {run}", [(sibling, run, sibling)], config.settings.budget)
            for sibling in config.siblings
            for run in runs
        ]
        for target in config.simulators:
            role = "twin" if target == config.twin else "migration"
            for origin in config.siblings:
                if origin != target:
                    expected = None if self.migrating is None else self.migrating.get(origin, 0)
                    groups = [(origin, run, target) for run in runs]
                    stages.append(self._stage(f"{role}: {origin} to {target}", groups, expected))
        results = ((name, self.results.get(name) == self.result_count) for name in STAGES)
        return [*stages, *(Stage(name=name, done=int(done), expected=1) for name, done in results)]

    def _stage(self, name: str, groups: Sequence[Group], expected: int | None) -> Stage:
        drives = [self.drives.get(group, FailureCount(0, 0)) for group in groups]
        excluded = sum(self.excluded.get(group, 0) for group in groups)
        failures, done = (sum(numbers) for numbers in zip(*drives, strict=True))
        return Stage(name=name, done=done + excluded, expected=expected, failures=failures, excluded=excluded)


def _tests_of(config: CampaignConfig) -> int:
    """Number of tests that the searches generate."""
    return config.settings.budget * config.search.runs * len(config.siblings)


def stages_of(data: CampaignData) -> list[Stage]:
    """List every stage of a campaign that was read, in the order in which they run."""
    return Tally.of(data).stages()


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
    return all(one.state == "done" for one in Tally.of_store(store, config).stages() if one.failures is not None)
