# SPDX-License-Identifier: Apache-2.0
"""Counts the drives of a goal for the orchestrator's messages."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence
from queue import SimpleQueue

from ds_interfaces.msg import CampaignState, TestOutcome

from ds_orchestrator.campaign.executor import Listener
from ds_orchestrator.campaign.live_file import Eta
from ds_orchestrator.store.model import Execution, Test
from ds_sim.gates.gate import Gate
from ds_studies.ros.campaign_messages import outcome_message


class StateListener(Listener):
    """Counts a goal's drives, and keeps their outcomes until they are published.

    Args:
        folder: campaign folder, as in the goal.
    """

    def __init__(self, folder: str) -> None:
        self._lock, self._eta, self._searching = threading.Lock(), Eta(), True
        self._state = CampaignState(state=CampaignState.RUNNING, folder=folder, seconds_left=-1.0)
        self.outcomes: SimpleQueue[TestOutcome] = SimpleQueue()

    def stage(self, name: str) -> None:
        """See `Listener.stage`."""
        with self._lock:
            self._state.stage = name
            self._eta.begin(time.monotonic())

    def expect(self, stages: Sequence[Mapping[str, int]]) -> None:
        """See `Listener.expect`."""
        with self._lock:
            self._eta.expect(stages)
            self._state.expected = sum(sum(stage.values()) for stage in stages)

    def finished(self, test: Test, simulator: str, execution: Execution | Gate | None, fresh: bool) -> None:
        """See `Listener.finished`."""
        with self._lock:
            self._state.done += 1
            self._state.failures += isinstance(execution, Execution) and execution.outcome.is_failure
            self._state.errors += execution is None
            self._eta.finished(int(test.sibling != simulator), simulator, time.monotonic(), fresh=fresh)
        self.outcomes.put(outcome_message(test.test_id, simulator, execution))

    def say(self, line: str) -> None:
        """Take a line about stages after driving, or about workers."""
        with self._lock:
            if line.startswith("stage: "):
                self._state.stage, self._eta = line.removeprefix("stage: "), Eta()
            else:
                self._state.message = line

    def end(self, state: int, message: str) -> None:
        """Set how the goal ended."""
        with self._lock:
            self._state.state, self._state.message, self._eta = state, message, Eta()

    @property
    def state(self) -> CampaignState:
        """Present state."""
        with self._lock:
            left = self._eta.seconds(time.monotonic())
            self._state.seconds_left = -1.0 if left is None else left
            fields = self._state.get_fields_and_field_types()
            return CampaignState(**{name: getattr(self._state, name) for name in fields})
