"""How far a campaign is, stage by stage."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from ds_orchestrator.campaign.campaign_data import CampaignData
from ds_orchestrator.campaign.folder import STAGES
from ds_orchestrator.maps.campaign_maps import elites_of
from ds_orchestrator.store.store import Execution


@dataclass(frozen=True, kw_only=True)
class Stage:
    """One line of a campaign's state.

    Attributes:
        name: `search bullet, run 0`, `migration bullet to softbody`, `twin donkey, tests of bullet`, `maps`, ...
        done: executions with a verdict, or 1 for a result that is up to date.
        expected: how many there will be; None as long as it is not known.
        failures: how many of those executions the driver failed; None for a result.
    """

    name: str
    done: int
    expected: int | None
    failures: int | None = None

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
    stages = []
    for sibling in config.siblings:
        for run in range(config.search.runs):
            mine = groups.get((sibling, run, sibling), [])
            stages.append(_stage(f"search {sibling}, run {run}", mine, budget))
    searched = len(tests) == budget * config.search.runs * len(config.siblings)
    migrated = {test.test_id for test in tests}
    if config.elites_only:
        migrated = elites_of(tests, executions, data.cells, ignored=data.given_up)
        searched = searched and all(stage.state == "done" for stage in stages)
    for target in config.simulators:
        for origin in config.siblings:
            if origin != target:
                runs = range(config.search.runs)
                mine = [e for run in runs for e in groups.get((origin, run, target), [])]
                role = "twin" if target == config.twin else "migration"
                expected = sum(of_test[test_id].sibling == origin for test_id in migrated) if searched else None
                stages.append(_stage(f"{role}: {origin} to {target}", mine, expected))
    count = len(data.executions)
    return [*stages, *(Stage(name=name, done=int(data.results.get(name) == count), expected=1) for name in STAGES)]


def is_driven(data: CampaignData) -> bool:
    """Whether every test of a campaign has its outcome everywhere, so that no graph is needed to go on with it."""
    return all(stage.state == "done" for stage in stages_of(data) if stage.failures is not None)


def _stage(name: str, executions: Iterable[Execution], expected: int | None) -> Stage:
    mine = list(executions)
    return Stage(name=name, done=len(mine), expected=expected, failures=sum(e.outcome.is_failure for e in mine))
