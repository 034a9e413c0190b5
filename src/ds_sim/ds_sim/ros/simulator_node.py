# SPDX-License-Identifier: Apache-2.0
"""Hosts any simulator as a ROS node: services to load a road, an action to drive it, lock-step by image stamp."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable
from typing import Any

from ds_interfaces.action import DriveRoad
from ds_interfaces.msg import DriveCommand
from ds_interfaces.srv import GetSimulatorInfo, LoadRoad
from rclpy.action.server import ServerGoalHandle
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from simulation_interfaces.msg import Result, SimulationState, SimulatorFeatures
from simulation_interfaces.srv import GetSimulationState, GetSimulatorFeatures, ResetSimulation, StepSimulation
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from ds_road import Road
from ds_sim.conditions.text import parse_conditions
from ds_sim.registry import SimulatorName, make_simulator
from ds_sim.ros import conversions as messages
from ds_sim.ros.command_monitor import CommandMonitor, CommandWatchdog
from ds_sim.ros.conversions import command_from_message
from ds_sim.ros.diagnostics import ERROR, EVERY, OK, WARN, Diagnostics, Report
from ds_sim.ros.frame_publisher import DrawnRows, FramePublisher
from ds_sim.ros.neighbours import Neighbours, two_drivers
from ds_sim.ros.parameters import declare
from ds_sim.ros.real_time_loop import RealTimeLoop
from ds_sim.ros.requests import SYNC_MODES, GoalServer, LoadedRoad, RequestRefused, check_goal, no_road
from ds_sim.ros.runtime import run_node, with_info
from ds_sim.ros.subscriptions import subscribe_to_commands
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


class SimulatorNode(Node):
    """Publishes a frame and, except in real time, takes no step until a command answers it."""

    def __init__(self, simulator: SimulatorName) -> None:
        super().__init__("simulator")
        name = SimulatorName(declare(self, "simulator", str(simulator), "Known simulator, or module:Class."))
        self._sync: str = declare(self, "sync", "lockstep", "Which command counts for a frame.", choices=SYNC_MODES)
        self._timeout: float = declare(
            self, "command_timeout", 5.0, "Longest wait for a command, s of the wall clock.", low=0.01, high=3600.0
        )
        clock = declare(self, "publish_clock", False, "Publish simulated time on /clock; one simulator of a graph may.")
        conditions = declare(
            self, "conditions", "", "Conditions of runs that bring none, such as visibility=40,friction=0.6."
        )
        default = parse_conditions(conditions)
        self._session = Session(make_simulator(name))
        spec = self._session.simulator.spec
        self._frames = FramePublisher(self, spec, clock=clock)
        self.drawn = DrawnRows(self._session.simulator, self._frames)
        self._neighbours, self._loaded = Neighbours(self), LoadedRoad(spec, default)
        self._sync_now, self._awaited = self._sync, Header()
        self._goal: ServerGoalHandle | None = None
        self._last: Observation | None = None
        self._watchdog, self._monitor = CommandWatchdog(self._timeout), CommandMonitor()
        subscribe_to_commands(self, DriveCommand, "drive", with_info(self._on_command), 10)
        self.create_service(LoadRoad, "load_road", self._on_load_road)
        self.create_service(GetSimulatorInfo, "get_info", lambda _, info: messages.info_response(spec, info))
        self.create_service(Trigger, "reset", self._on_reset)
        self._server = GoalServer(self, DriveRoad, "drive_road", self._begin)
        self._outcomes: Counter[Outcome] = Counter()
        Diagnostics(self, "simulator", self._report)
        self._standard = StandardControl(self, self._session, self._loaded, self._frames, self._check_idle)
        # Steady clock: the node's own may be simulated time (use_sim_time), which stands still between runs.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._real_time = RealTimeLoop(self, steady, self._advance)
        self.create_timer(0.05, self._watch, clock=steady)
        self.get_logger().info(f"{name} is ready in {self.get_namespace()}")

    def destroy_node(self) -> None:
        """Close the simulator with the node."""
        self._session.simulator.close()
        super().destroy_node()

    def _on_load_road(self, request: LoadRoad.Request, response: LoadRoad.Response) -> LoadRoad.Response:
        try:
            road = self._load(request)
        except RequestRefused as refused:
            response.reason.value, response.message = int(refused.reason), str(refused)
            self.get_logger().warning(f"road refused: {refused}")
        else:
            response.accepted, response.road_id, response.length = True, road.road_id, road.length
        return response

    def _on_reset(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """End the current run; the loaded road stays loaded."""
        response.success = self._loaded.scenario is not None
        response.message = "" if response.success else str(no_road())
        self._finish(Outcome.CANCELLED, "reset was called", Reason.RESET)
        return response

    def _load(self, request: LoadRoad.Request | DriveRoad.Goal) -> Road:
        self._check_idle()
        road = self._loaded.load(request)
        self._frames.publish_road(road)
        return road

    def _check_idle(self) -> None:
        if self._goal is not None and self._session.run is not None:
            raise self._neighbours.busy(self._session.run.road.road_id)

    def _begin(self, goal: ServerGoalHandle) -> None:
        """Begin a run; its goal starts executing only when the run has ended."""
        request = goal.request
        check_goal(request.sync, request.command_timeout)
        self._check_idle()
        self._neighbours.check_alone()
        if request.road.control_points:
            self._load(request)
        scenario = self._loaded.scenario
        if scenario is None:
            raise no_road()
        self._goal = goal
        self._sync_now = request.sync or self._sync
        self.drawn.choose()
        self._standard.leave()
        first = self._session.start(scenario)  # costs the driver no time
        limit = request.command_timeout or self._timeout
        self._watchdog = CommandWatchdog(limit, frames_wait=self._sync_now != "realtime")
        self._monitor = CommandMonitor()
        self._show(first)

    def _show(self, observation: Observation | None) -> None:
        """Publish a frame and wait for its answer, or hand over the result if the run has ended."""
        self._last = observation
        if observation is not None and self._session.run is not None:
            road = self._session.run.road
            self._awaited = self._frames.publish(observation, road)
            self._watchdog.sent(observation.step)
            self._monitor.frame(self._awaited.stamp)
        self._hand_over_if_ended()

    def _on_command(self, message: DriveCommand, info: dict[str, Any]) -> None:
        if self._goal is None:
            self._standard.hold(message)
            return
        if not self._session.driving:
            return
        self._monitor.command(info.get("publication_sequence_number"))
        if self._monitor.two_drivers:
            self._finish(Outcome.SIM_ERROR, two_drivers(self._neighbours.drivers()), Reason.TWO_DRIVERS)
            return
        if self._sync_now == "lockstep" and message.header.stamp != self._awaited.stamp:
            if self._monitor.stray(message.header.stamp):
                self.get_logger().warning(self._monitor.complaint())
            return
        try:
            command = messages.command_from_message(message)
        except CommandError as error:
            self._monitor.refused(error)
            self.get_logger().warning(f"command refused: {error}", throttle_duration_sec=1.0)
            return
        self._watchdog.heard()
        if self._sync_now == "realtime":
            self._real_time.hold(command)
        else:
            self._advance(command)

    def _advance(self, command: Command) -> None:
        if self._goal is None or not self._session.driving:
            return  # a real-time tick that fired just after the run ended
        observation = self._session.advance(command)
        if observation is not None and self._session.run and observation.step % messages.FEEDBACK_EVERY == 0:
            self._goal.publish_feedback(messages.drive_feedback(observation, self._session.run.road))
        self._show(observation)

    def _watch(self) -> None:
        """End a run whose client cancelled it or whose driver is silent."""
        if self._goal is None or not self._session.driving or self._last is None:
            return
        if self._goal.is_cancel_requested:
            self._finish(Outcome.CANCELLED, "cancelled by the client")
        elif self._watchdog.is_over:
            self._finish(Outcome.DRIVER_SILENT, *self._monitor.silence(self._watchdog.limit, self._last.step))
        elif self._watchdog.wants_repeat:
            self._show(self._last)

    def _report(self) -> Report:
        run = self._session.run
        values: dict[str, object] = {outcome.name.lower(): count for outcome, count in self._outcomes.items()}
        if run is not None:
            values |= {"road": run.road.road_id, "frame": run.steps}
        if crowd := self._neighbours.crowd():
            return ERROR, crowd, values
        if run is None:
            return OK, "waits for a goal", values
        if not self._session.driving:
            text = f"the last run ended {run.outcome.name}: {run.message}".removesuffix(": ")
            return WARN if run.outcome.is_error else OK, text, values
        if self._goal is not None and self._watchdog.waited > EVERY:
            return WARN, f"no command for {self._watchdog.waited:.1f} s after frame {run.steps}", values
        return OK, f"drives road {run.road.road_id}", values

    def _finish(self, outcome: Outcome, message: str, reason: Reason = Reason.NONE) -> None:
        self._session.end(outcome, message, reason)
        self._hand_over_if_ended()

    def _hand_over_if_ended(self) -> None:
        goal, run = self._goal, self._session.run
        if goal is None or run is None or self._session.driving:
            return
        self._goal = None
        self._outcomes[run.outcome] += 1
        run.message = "; ".join(filter(None, (run.message, self._real_time.end())))
        self._frames.end_run(run.simulated_seconds)
        self.get_logger().info(f"{run.road.road_id}: {run.outcome.name} after {run.steps} steps {run.message}".rstrip())
        self._server.close(goal, messages.drive_result(run), lambda: messages.close_goal(goal, run.outcome))


def main(simulator: str = "bullet") -> None:
    """Host the simulator named by the parameter `simulator`, by default this one."""
    sys.exit(run_node(lambda: SimulatorNode(SimulatorName(simulator))))


if __name__ == "__main__":
    main()
