"""Drives roads for a sensitivity analysis with an engine, several at a time, and keeps each result in a store."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ds_driver.networks.pilot import DriverError
from ds_orchestrator.campaign.engine import DriveSettings, Engine
from ds_orchestrator.campaign.executor import Executor, Listener, NoOutcomeError
from ds_orchestrator.store.model import Execution, Test
from ds_orchestrator.store.store import Store
from ds_road import Road
from ds_sim.conditions.model import Conditions
from ds_sim.conditions.text import format_conditions
from ds_studies.sensitivity.measurement import GATE


class Drives:
    """Drives of one driver and of the gates.

    Args:
        settings: driver and simulators.
        engine: drives.
        tested: keeps the driver's executions.
        gates: keeps the gates, which do not depend on the driver.
    """

    def __init__(self, settings: DriveSettings, engine: Engine, tested: Store, gates: Store) -> None:
        self._engine, self._tested, self._gates = engine, tested, gates
        self._executor = Executor(replace(settings, gates="none"), Path(), tested, engine, Listener())
        self._gatekeeper = Executor(replace(settings, gates="all"), Path(), gates, engine, Listener())

    def stop(self) -> None:
        """End every drive now, and start no further one."""
        self._executor.stop()
        self._gatekeeper.stop()
        self._engine.stop()

    def fails(self, simulator: str, road: Road, seed: int, who: str, conditions: Conditions) -> bool:
        """Whether the driver fails, or for `GATE` whether no driver can be judged.

        Raises:
            DriverError: every attempt ended in an error, which is no result.
            ds_orchestrator.campaign.executor.CampaignError: the simulator gave no outcome for several tests in a row.
            ds_orchestrator.campaign.executor.Stopped: `stop` was called.
        """
        name = "-".join(filter(None, (road.road_id, str(seed), format_conditions(conditions))))
        test = Test(test_id=name, sibling=simulator, run=0, number=0, road=road, seed=seed, conditions=conditions)
        error = f"{simulator}, road {road.road_id}, seed {seed}: "
        if who == GATE:
            self._gates.add_test(test)
            try:
                gate = self._gatekeeper.judge(test, simulator)
            except NoOutcomeError as failed:
                raise DriverError(f"{error}{failed}") from None
            return gate is not None and not gate.is_valid
        self._tested.add_test(test)
        found = self._executor.execute(test, simulator)
        if found is None:
            last = [row for row in self._tested.errors() if row[:2] == (name, simulator)][-1]
            raise DriverError(error + ": ".join(filter(None, (last[3].lower(), last[4]))))
        return found.outcome.is_failure if isinstance(found, Execution) else True
