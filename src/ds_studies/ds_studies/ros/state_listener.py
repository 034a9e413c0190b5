# SPDX-License-Identifier: Apache-2.0
"""Counts the drives of a goal for the orchestrator's messages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from queue import SimpleQueue

from ds_interfaces.msg import CampaignState, TestOutcome

from ds_orchestrator.campaign.eta import Eta, TimedListener
from ds_orchestrator.store.model import Execution, Test
from ds_sim.gates.gate import Gate
from ds_sim.registry import SimulatorName
from ds_studies.ros.campaign_messages import outcome_message


class StateListener(TimedListener):
    """Counts a goal's drives, and keeps their outcomes until they are published."""

    def __init__(self, folder: str) -> None:
        super().__init__()
        self._searching = True
        self._state = CampaignState(state=CampaignState.RUNNING, folder=folder, seconds_left=-1.0)
        self.outcomes: SimpleQueue[TestOutcome] = SimpleQueue()

    def stage(self, name: str) -> None:
        """See `Listener.stage`."""
        super().stage(name)
        with self._lock:
            self._state.stage = name

    def expect(self, stages: Sequence[Mapping[SimulatorName, int]]) -> None:
        """See `Listener.expect`."""
        super().expect(stages)
        with self._lock:
            self._state.expected = self.total

    def finished(self, test: Test, simulator: SimulatorName, execution: Execution | Gate | None, fresh: bool) -> None:
        """See `Listener.finished`."""
        super().finished(test, simulator, execution, fresh)
        with self._lock:
            self._state.done = self.done
            self._state.failures += isinstance(execution, Execution) and execution.outcome.is_failure
            self._state.errors += execution is None
        self.outcomes.put(outcome_message(self._state.folder, test.test_id, simulator, execution))

    def hear(self, line: str) -> None:
        """Make a line of the product's loggers the state's message."""
        with self._lock:
            self._state.message = line

    def end(self, state: int, message: str) -> None:
        """Set how the goal ended."""
        with self._lock:
            self._state.state, self._state.message, self._eta = state, message, Eta()

    @property
    def state(self) -> CampaignState:
        """Present state."""
        with self._lock:
            left = self.seconds_left()
            self._state.seconds_left = -1.0 if left is None else left
            fields = self._state.get_fields_and_field_types()
            return CampaignState(**{name: getattr(self._state, name) for name in fields})
