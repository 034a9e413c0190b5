"""Campaign read once from its store; maps, evaluation and report all use this copy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.folder import config_of
from ds_orchestrator.maps.campaign_maps import cells_of
from ds_orchestrator.search.features import Cell
from ds_orchestrator.store.model import Execution, Test
from ds_orchestrator.store.store import Store
from ds_sim.gates.gate import Gate


@dataclass(frozen=True, kw_only=True)
class CampaignData:
    """Contents of a campaign's store at one moment, finished or not.

    Attributes:
        config: configuration as run.
        tests: every test, by sibling, run and number.
        executions: every execution, by simulator and test.
        gates: test and simulator -> what the gates say; tests that they exclude have no execution there.
        notes: facts such as versions and times.
        errors: attempts that ended in an error: test, simulator, attempt, outcome, message.
        given_up: tests whose search continued without their outcome.
        searches: runs of a search: sibling, run, method, seed.
        results: result -> number of executions from which it was computed.
    """

    config: CampaignConfig
    tests: tuple[Test, ...] = ()
    executions: tuple[Execution, ...] = ()
    gates: Mapping[tuple[str, str], Gate] = field(default_factory=dict)
    notes: Mapping[str, str] = field(default_factory=dict)
    errors: tuple[tuple[str, str, int, str, str], ...] = ()
    given_up: frozenset[str] = frozenset()
    searches: tuple[tuple[str, int, str, int], ...] = ()
    results: Mapping[str, int] = field(default_factory=dict)

    @cached_property
    def verdicts(self) -> tuple[Execution, ...]:
        """Executions that ended in a verdict on the driver."""
        return tuple(e for e in self.executions if e.outcome.is_verdict)

    @cached_property
    def excluded(self) -> dict[tuple[str, str], Gate]:
        """Test and simulator -> why no network can be judged by it there."""
        return {key: gate for key, gate in self.gates.items() if not gate.is_valid}

    @property
    def result_count(self) -> int:
        """Number of executions and gates, from which maps, evaluation and report are made."""
        return len(self.executions) + len(self.gates)

    @cached_property
    def cells(self) -> dict[str, Cell]:
        """Test -> cell over all features of the campaign, for tests that have one."""
        config = self.config
        return cells_of(
            self.tests,
            self.executions,
            features=config.features,
            maxitwo_compatible=config.maxitwo_compatible,
            gates=self.gates,
        )


def read_campaign(store: Store) -> CampaignData:
    """Read a campaign without its trajectories, each of which is read when it is first asked for.

    Raises:
        ds_orchestrator.store.sqlite_file.StoreError: the file is damaged.
        ds_orchestrator.campaign.config.ConfigError: its configuration is not valid.
    """
    # Executions first: a test is stored before its executions, so none is without its test while a campaign runs.
    executions, gates = tuple(store.executions()), store.gates()
    return CampaignData(
        config=config_of(store),
        tests=tuple(store.tests()),
        executions=executions,
        gates=gates,
        notes=store.notes(),
        errors=tuple(store.errors()),
        given_up=frozenset(store.given_up()),
        searches=tuple(store.searches()),
        results=store.results(),
    )
