# SPDX-License-Identifier: Apache-2.0
"""Reads a campaign repeatedly while another process writes it, each time only what is new."""

from __future__ import annotations

import time
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path

from ds_base.folder_files import StoreError
from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.folder import CampaignData, config_of, open_store
from ds_orchestrator.campaign.live_file import Live, read_live
from ds_orchestrator.maps.campaign_maps import cell_of_test
from ds_orchestrator.search.features import Cell
from ds_orchestrator.store.model import NO_DRIVE, Execution, Test
from ds_orchestrator.store.store import Store
from ds_sim.registry import SimulatorName


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """A campaign at one moment."""

    data: CampaignData  # contents of the store; executions without their trajectories
    latest: dict[str, str]  # simulator -> test that was driven there last
    live: Live | None  # what the campaign does, or None if no process works on it
    complete: bool  # whether everything was driven and the report is up to date
    at: float  # time of reading, s since 1970


@dataclass
class _Known:
    """What was read so far."""

    config: CampaignConfig
    tests: dict[str, Test] = field(default_factory=dict)
    executions: dict[tuple[str, SimulatorName], Execution] = field(default_factory=dict)
    cells: dict[str, Cell] = field(default_factory=dict)
    rows: tuple[int, int] = (0, 0)
    last_test: str | None = None


class CampaignReader:
    """Reads the campaign in a folder, without writing to it and without taking a lock.

    Raises:
        ds_orchestrator.store.sqlite_file.StoreError: the folder holds no campaign, or a damaged one.
        ds_orchestrator.campaign.config.ConfigError: its configuration is not valid.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        with self._opened() as store:
            self._known = _Known(config=config_of(store))

    @property
    def config(self) -> CampaignConfig:
        """The campaign's configuration."""
        return self._known.config

    def read(self) -> Snapshot:
        """Read what is new; `StoreError` if the file is damaged, or was replaced while it was read."""
        with self._opened() as store:
            try:
                self._read_new(store)
            except StoreError:
                self._known = _Known(config=self._known.config)
                raise
            campaign, results, count = self._known, store.results(), store.count_results()
            latest = store.latest_executions()
            data = CampaignData(
                config=campaign.config,
                tests=tuple(campaign.tests.values()),
                executions=tuple(campaign.executions.values()),
                gates=store.gates(),
                errors=tuple(store.errors()),
                given_up=frozenset(store.given_up()),
                results=results,
            )
        # The cells were computed with the trajectories, which are not kept.
        vars(data)["cells"] = dict(campaign.cells)
        now = time.time()
        live = read_live(self.folder, now)
        driven = len(campaign.executions) + len(data.excluded)
        complete = campaign.config.elites_only or driven >= campaign.config.executions_at_most
        complete = complete and results.get("report") == count
        return Snapshot(
            data=data,
            latest={name: test_id for name, test_id in latest.items() if (test_id, name) in campaign.executions},
            live=live,
            complete=complete,
            at=now,
        )

    def execution(self, test_id: str, simulator: SimulatorName) -> tuple[Test, Execution] | None:
        """Read one execution with its trajectory, and its test; None if there is none."""
        test = self._known.tests.get(test_id)
        if test is None:
            return None
        with self._opened() as store:
            execution = store.execution(test_id, simulator)
        return None if execution is None else (test, execution)

    def _opened(self) -> closing[Store]:
        return closing(open_store(self.folder))

    def _read_new(self, store: Store) -> None:
        campaign = self._known
        last = store.last_rows()
        same = store.test_of_row(campaign.rows[0]) == campaign.last_test and last[1] >= campaign.rows[1]
        if not same or store.count_tests() < len(campaign.tests):
            # A stopped search took back its last tests, or the folder was replaced.
            campaign = self._known = _Known(config=config_of(store))
        executions = store.executions(after=campaign.rows[1])
        # Tests after executions: a test is stored before its executions.
        campaign.tests |= {test.test_id: test for test in store.tests(after=campaign.rows[0])}
        gates = store.gates()
        for execution in executions:
            test = campaign.tests.get(execution.test_id)
            if test is None or execution.simulator not in campaign.config.simulators:
                raise StoreError(f"{self.folder} has changed while it was read")
            campaign.executions[execution.test_id, execution.simulator] = replace(execution, drive=NO_DRIVE)
            cell = cell_of_test(
                test,
                execution if execution.simulator == test.sibling else None,
                gates.get((execution.test_id, test.sibling)),
                campaign.config.features,
                maxitwo_compatible=campaign.config.maxitwo_compatible,
            )
            if cell is not None:
                campaign.cells[execution.test_id] = cell
        campaign.rows, campaign.last_test = last, store.test_of_row(last[0])
