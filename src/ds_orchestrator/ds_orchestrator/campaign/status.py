"""Progress of a campaign, stage by stage."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from ds_orchestrator.campaign.campaign_data import CampaignData
from ds_orchestrator.campaign.folder import STAGES
from ds_orchestrator.maps.campaign_maps import elites_of
from ds_orchestrator.store.model import Execution


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


def stages_of(data: CampaignData) -> list[Stage]:
    """List every stage in the order in which they run."""
    config, tests, executions = data.config, data.tests, data.verdicts
    of_test = {test.test_id: test for test in tests}
    budget = config.settings.budget
    groups: dict[tuple[str, int, str], list[Execution]] = {}
    for execution in executions:
        test = of_test[execution.test_id]
        groups.setdefault((test.sibling, test.run, execution.simulator), []).append(execution)
    excluded: dict[tuple[str, int, str], int] = {}
    for test_id, simulator in data.excluded:
        key = (of_test[test_id].sibling, of_test[test_id].run, simulator)
        excluded[key] = excluded.get(key, 0) + 1
    stages = []
    for sibling in config.siblings:
        for run in range(config.search.runs):
            found = groups.get((sibling, run, sibling), [])
            stages.append(
                _stage(f"search {sibling}, run {run}", found, budget, excluded.get((sibling, run, sibling), 0))
            )
    searched = len(tests) == budget * config.search.runs * len(config.siblings)
    migrated = {test.test_id for test in tests}
    if config.elites_only:
        migrated = elites_of(tests, executions, data.cells, ignored=data.given_up)
        decided = {e.test_id for e in executions if of_test[e.test_id].sibling == e.simulator} | set(data.given_up)
        decided |= {test_id for test_id, simulator in data.excluded if of_test[test_id].sibling == simulator}
        searched = searched and set(of_test) <= decided
    for target in config.simulators:
        for origin in config.siblings:
            if origin != target:
                runs = range(config.search.runs)
                found = [e for run in runs for e in groups.get((origin, run, target), [])]
                role = "twin" if target == config.twin else "migration"
                expected = sum(of_test[test_id].sibling == origin for test_id in migrated) if searched else None
                left_out = sum(excluded.get((origin, run, target), 0) for run in runs)
                stages.append(_stage(f"{role}: {origin} to {target}", found, expected, left_out))
    count = data.result_count
    return [*stages, *(Stage(name=name, done=int(data.results.get(name) == count), expected=1) for name in STAGES)]


def is_driven(data: CampaignData) -> bool:
    """Check whether every driving stage is done, so that resuming the campaign needs no graph."""
    return all(stage.state == "done" for stage in stages_of(data) if stage.failures is not None)


def _stage(name: str, executions: Iterable[Execution], expected: int | None, excluded: int) -> Stage:
    found = list(executions)
    failures = sum(e.outcome.is_failure for e in found)
    return Stage(name=name, done=len(found) + excluded, expected=expected, failures=failures, excluded=excluded)
