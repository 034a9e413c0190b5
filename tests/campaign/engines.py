# SPDX-License-Identifier: Apache-2.0
"""Engines for campaigns without ROS."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext

import numpy as np
import pytest
from tests.observations import made_observation

from ds_driver.closed_loop.simulation import DriveRequest
from ds_driver.control.autopilot import Autopilot
from ds_orchestrator.campaign.engine import DriveSettings, Engine, Watch
from ds_orchestrator.campaign.executor import Stopped
from ds_orchestrator.engines.start import ENGINES
from ds_sim.registry import make_simulator
from ds_sim.session import RunRecord, Session
from ds_sim.simulator import Command, Outcome


class EngineHere:
    """Drives in this process, and raises `Stopped` after so many runs; `errors` of them fail after the first ones."""

    def __init__(self, *, runs: int = 10_000, errors: int = 0, errors_after: int = 0) -> None:
        self.roads: list[tuple[str, str]] = []
        self._left, self._errors, self._errors_after = runs, errors, errors_after
        self.error = Outcome.DRIVER_SILENT

    capacity: int | None = None

    def stop(self) -> None: ...

    def drive(self, request: DriveRequest, watch: Watch | None = None) -> RunRecord:
        if self._left == 0:
            raise Stopped
        if self._errors and len(self.roads) >= self._errors_after:
            self._errors -= 1
            return request.ended(self.error, "no command within 1 s")
        self._left -= 1
        self.roads.append((request.simulator, request.road.road_id))
        return self._run(request)

    def _run(self, request: DriveRequest) -> RunRecord:
        made = make_simulator(request.simulator)
        session, pilot = Session(made), Autopilot(made.spec.autopilot)
        observation = session.start(request.scenario)
        while session.driving and observation is not None and observation.step < 60:
            command = pilot.command(observation.lane.preview_lateral_position, observation.vehicle.speed)
            observation = session.advance(command)
        assert session.run is not None
        if session.driving:
            session.end(Outcome.TIMEOUT, "sixty steps are enough for a test")
        made.close()
        return session.run


def use_engines(monkeypatch: pytest.MonkeyPatch, start: Callable[[DriveSettings], Engine]) -> None:
    """Let every engine that is started be one that a function makes."""
    for name in tuple(ENGINES):
        monkeypatch.setitem(ENGINES, name, lambda settings, _: nullcontext(start(settings)))


class MadeUpEngine(EngineHere):
    """Drives nothing: generates an outcome from simulator, road and seed at once."""

    def _run(self, request: DriveRequest) -> RunRecord:
        rng = np.random.default_rng([request.seed, len(request.simulator), int(request.road.road_id, 16)])
        lateral = np.append(0.0, rng.uniform(-2.6, 2.6, 5))
        failed = bool(np.abs(lateral).max() > request.road.lane_width / 2)
        x, y = request.road.lane_centre[0].tolist()
        outcome = Outcome.OUT_OF_BOUNDS if failed else Outcome.COMPLETED
        run = RunRecord(scenario=request.scenario, outcome=outcome)
        run.commands = [Command(float(s), 0.5) for s in rng.uniform(-0.2, 0.2, 5)]
        run.observations = [
            made_observation(k, lateral=offset, outcome=Outcome.RUNNING if k < 5 else outcome, x=x, y=y + k)
            for k, offset in enumerate(lateral.tolist())
        ]
        return run
