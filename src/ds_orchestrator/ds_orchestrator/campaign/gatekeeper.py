"""Decides, before a network drives a test on a simulator, whether it can be judged by it; see `ds_sim.gates`."""

from __future__ import annotations

from collections.abc import Callable

from ds_driver.closed_loop.drive_request import DriveRequest
from ds_driver.control.autopilot import AUTOPILOT
from ds_orchestrator.campaign.drive_settings import DriveSettings
from ds_orchestrator.campaign.engine import Engine
from ds_orchestrator.store.model import Test
from ds_orchestrator.store.store import Store
from ds_sim.conditions.loading import check_applicable
from ds_sim.conditions.model import NotApplicableError
from ds_sim.gates.gate import Gate, gate_of, not_applicable
from ds_sim.registry import spec_of
from ds_sim.session import RunRecord
from ds_sim.simulator import Reason


class GateError(RuntimeError):
    """The autopilot's run ended in an error on every attempt, which says nothing about the test.

    Attributes:
        run: last attempt.
    """

    def __init__(self, run: RunRecord) -> None:
        super().__init__(f"{run.outcome.name}: {run.message}")
        self.run = run


class Gatekeeper:
    """Judges each test once on each simulator, and keeps the result in the store.

    Args:
        settings: how tests are driven.
        store: keeps the gates.
        engine: drives the autopilot.
    """

    def __init__(self, settings: DriveSettings, store: Store, engine: Engine) -> None:
        self._settings, self._store, self._engine = settings, store, engine

    def judge(self, test: Test, simulator: str, *, check_stop: Callable[[], None]) -> Gate | None:
        """Judge a test on a simulator; None if it has no gate.

        Args:
            test: test to judge.
            simulator: name of the simulator.
            check_stop: called before every attempt and after every failed one; may raise.

        Raises:
            GateError: every attempt ended in an error.
        """
        if self._settings.gates == "none" or (test.conditions.is_default and self._settings.gates != "all"):
            return None
        known = self._store.gate(test.test_id, simulator)
        if known is not None:
            return known
        try:
            check_applicable(test.conditions, spec_of(simulator))
        except NotApplicableError as error:
            return self.refused(test, simulator, str(error))
        for attempt in range(self._settings.retries + 1):
            check_stop()
            run = self._engine.drive(
                DriveRequest(simulator, AUTOPILOT, test.road, test.seed, test.conditions, probed=True)
            )
            if run.outcome.is_verdict:
                gate = gate_of(run)
                self._store.add_gate(test.test_id, simulator, gate)
                return gate
            if run.reason is Reason.NOT_APPLICABLE:
                return self.refused(test, simulator, run.message)
            check_stop()
            self._store.add_error(test.test_id, simulator, attempt, run.outcome, f"autopilot: {run.message}")
        raise GateError(run)

    def refused(self, test: Test, simulator: str, message: str) -> Gate:
        """Keep that a simulator cannot realise a test."""
        gate = not_applicable(message)
        self._store.add_gate(test.test_id, simulator, gate)
        return gate
