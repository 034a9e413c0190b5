# SPDX-License-Identifier: Apache-2.0
"""Services of the standard simulation_interfaces, by which others step a simulator's node instead of driving a goal."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ds_interfaces.msg import DriveCommand
from rclpy.node import Node
from simulation_interfaces.msg import Result, SimulationState, SimulatorFeatures
from simulation_interfaces.srv import GetSimulationState, GetSimulatorFeatures, ResetSimulation, StepSimulation

from ds_sim.ros.conversions import command_from_message
from ds_sim.ros.frame_publisher import FramePublisher
from ds_sim.ros.requests import LoadedRoad, RequestRefused, no_road
from ds_sim.session import RunRecord, Session
from ds_sim.simulator import Command, CommandError, Observation, Outcome, Reason

FEATURES = (
    SimulatorFeatures.SIMULATION_RESET,
    SimulatorFeatures.SIMULATION_RESET_TIME,
    SimulatorFeatures.SIMULATION_RESET_STATE,
    SimulatorFeatures.SIMULATION_STATE_GETTING,
    SimulatorFeatures.STEP_SIMULATION_SINGLE,
    SimulatorFeatures.STEP_SIMULATION_MULTIPLE,
)
INFO = "a step is a frame of 1/20 s, driven with the last command; load_road spawns road and car; stamps never go back"


class StandardControl:
    """Steps runs that belong to no goal, and publishes their frames as those of any other run.

    `check_idle` raises RequestRefused while a goal has the simulator.
    """

    def __init__(
        self,
        node: Node,
        session: Session,
        loaded: LoadedRoad,
        frames: FramePublisher,
        check_idle: Callable[[], None],
    ) -> None:
        self._session, self._loaded, self._frames, self._check_idle = session, loaded, frames, check_idle
        self._run: RunRecord | None = None
        self._command, self._log = Command(0.0, 0.0), node.get_logger()
        for kind, name, answer in (
            (GetSimulatorFeatures, "get_simulator_features", self._features),
            (GetSimulationState, "get_simulation_state", self._state),
            (StepSimulation, "step_simulation", self._step),
            (ResetSimulation, "reset_simulation", self._reset),
        ):
            node.create_service(kind, name, answer)

    def hold(self, message: DriveCommand) -> None:
        """Drive the steps to come with a command."""
        try:
            self._command = command_from_message(message)
        except CommandError as error:
            self._log.warning(f"command refused: {error}", throttle_duration_sec=1.0)

    def leave(self) -> None:
        """End a run that is stepped, so that another can begin."""
        if self._stepping:
            self._session.end(Outcome.CANCELLED, "another run began", Reason.RESET)
            self._end()

    @property
    def _stepping(self) -> bool:
        return self._session.driving and self._session.run is self._run

    def _features(self, _: Any, response: GetSimulatorFeatures.Response) -> GetSimulatorFeatures.Response:
        response.features.features, response.features.custom_info = list(FEATURES), INFO
        return response

    def _state(self, _: Any, response: GetSimulationState.Response) -> GetSimulationState.Response:
        states = SimulationState
        if self._session.driving:
            response.state.state = states.STATE_PAUSED if self._stepping else states.STATE_PLAYING
        else:
            response.state.state = states.STATE_NO_WORLD if self._loaded.scenario is None else states.STATE_STOPPED
        response.result.result = Result.RESULT_OK
        return response

    def _reset(self, _: Any, response: ResetSimulation.Response) -> ResetSimulation.Response:
        """Begin a run on the loaded road, whatever the scope: time, pose and speeds go together here."""
        response.result = self._answer(self._begin)
        return response

    def _step(self, request: StepSimulation.Request, response: StepSimulation.Response) -> StepSimulation.Response:
        response.result = self._answer(lambda: self._advance(request.steps))
        return response

    def _answer(self, act: Callable[[], str]) -> Result:
        """Do what was asked unless a goal or a missing road forbids it; `act` returns why it failed, or ""."""
        try:
            self._check_idle()
            if self._loaded.scenario is None:
                raise no_road()
        except RequestRefused as refused:
            return Result(result=Result.RESULT_INCORRECT_STATE, error_message=str(refused))
        failed = act()
        return Result(result=Result.RESULT_OPERATION_FAILED if failed else Result.RESULT_OK, error_message=failed)

    def _begin(self) -> str:
        assert self._loaded.scenario is not None
        self.leave()
        self._command = Command(0.0, 0.0)
        observation = self._session.start(self._loaded.scenario)
        self._run = self._session.run
        return self._show(observation)

    def _advance(self, steps: int) -> str:
        if (self._run is None or self._session.run is not self._run) and (failed := self._begin()):
            return failed
        for _ in range(steps):
            if not self._session.driving:
                return "the run has ended: call reset_simulation"
            if failed := self._show(self._session.advance(self._command)):
                return failed
        return ""

    def _show(self, observation: Observation | None) -> str:
        run = self._session.run
        assert run is not None
        if observation is not None:
            self._frames.publish(observation, run.road)
        if not self._session.driving:
            self._end()
        return run.message if observation is None else ""

    def _end(self) -> None:
        assert self._run is not None
        self._frames.end_run(self._run.simulated_seconds)
