"""The ROS node that hosts any simulator: services to load a road, an action to drive it, lock-step by image stamp."""

from __future__ import annotations

import sys

from ds_interfaces.action import DriveRoad
from ds_interfaces.msg import DriveCommand
from ds_interfaces.srv import GetSimulatorInfo, LoadRoad
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from ds_road import Road, RoadError
from ds_sim.registry import make_simulator
from ds_sim.ros import conversions as messages
from ds_sim.ros.command_watchdog import CommandWatchdog
from ds_sim.ros.frame_publisher import FramePublisher
from ds_sim.ros.real_time_loop import RealTimeLoop
from ds_sim.ros.runtime import run_node
from ds_sim.ros.simulator_parameters import check_goal, declare_parameters
from ds_sim.session import Session
from ds_sim.simulator import FRAME_TIME, Command, CommandError, Observation, Outcome


class SimulatorNode(Node):
    """Publishes a frame, and takes no step until a command answers it.

    Args:
        simulator: default of the parameter `simulator`.
    """

    def __init__(self, simulator: str) -> None:
        super().__init__("simulator")
        parameters = declare_parameters(self, simulator)
        self._sync, self._timeout = parameters.sync, parameters.command_timeout
        self._session = Session(make_simulator(parameters.simulator))
        self._frames = FramePublisher(self, self._session.simulator.spec, clock=parameters.publish_clock)
        self._road: Road | None = None
        self._seed, self._sync_now = 0, self._sync
        self._goal: ServerGoalHandle | None = None
        self._handed_over, self._refused = False, ""
        self._last: Observation | None = None
        self._awaited = Header()
        self._patience = CommandWatchdog(self._timeout)
        # Stamps never go back over the life of the node, as tf, bags and filters expect of a clock; they begin above
        # 0, so that a driver that leaves its stamp unset never answers by chance.
        self._run_start = 1.0
        self.create_subscription(DriveCommand, "drive", self._on_command, 10)
        self.create_service(LoadRoad, "load_road", self._on_load_road)
        self.create_service(GetSimulatorInfo, "get_info", self._on_get_info)
        self.create_service(Trigger, "reset", self._on_reset)
        self._server = ActionServer(
            self,
            DriveRoad,
            "drive_road",
            execute_callback=self._result,
            goal_callback=self._on_goal,
            handle_accepted_callback=self._on_accepted,
            cancel_callback=lambda _goal: CancelResponse.ACCEPT,
        )
        # By a clock of their own: the node's may be simulated time (use_sim_time), which stands while nobody drives.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._real_time = RealTimeLoop(self, steady, self._advance)
        self.create_timer(0.05, self._watch, clock=steady)
        self.get_logger().info(f"{parameters.simulator} is ready in {self.get_namespace()}")

    def destroy_node(self) -> None:
        """Close the simulator with the node."""
        self._session.simulator.close()
        super().destroy_node()

    def _on_get_info(self, _: object, response: GetSimulatorInfo.Response) -> GetSimulatorInfo.Response:
        return messages.info_response(self._session.simulator.spec, response)

    def _on_load_road(self, request: LoadRoad.Request, response: LoadRoad.Response) -> LoadRoad.Response:
        try:
            road = self._load(messages.road_from_message(request.road), request.seed)
        except RoadError as error:
            response.reason = str(error)
            self.get_logger().warning(f"road refused: {error}")
            return response
        response.accepted, response.road_id, response.length = True, road.road_id, road.length
        return response

    def _on_reset(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """End the run under way; the loaded road stays, and every run begins at its start anyway."""
        response.success = self._road is not None
        response.message = "" if response.success else messages.NO_ROAD
        self._finish(Outcome.CANCELLED, "reset was called")
        return response

    def _load(self, road: Road, seed: int) -> Road:
        """Check a road and keep it; each run builds its world anew."""
        if self._goal is not None:
            raise RoadError(messages.BUSY)
        if not road.validity.valid:
            raise RoadError(f"the road is not valid: {road.validity.reason}")
        self._road, self._seed = road, seed
        self._frames.publish_road(road, self._run_start)
        return road

    def _on_goal(self, goal: DriveRoad.Goal) -> GoalResponse:
        try:
            check_goal(goal.sync, goal.command_timeout)
            if goal.road.control_points:
                self._load(messages.road_from_message(goal.road), goal.seed)
            if self._road is None:
                raise RoadError(messages.NO_ROAD)
            if self._goal is not None:
                raise RoadError(messages.BUSY)
        except ValueError as error:
            self.get_logger().warning(f"goal refused: {error}")
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _on_accepted(self, goal: ServerGoalHandle) -> None:
        """Begin the run; the goal is executed, in the action's sense, when the run has ended."""
        assert self._road is not None
        self._goal = goal
        self._handed_over, self._refused = False, ""
        self._sync_now = goal.request.sync or self._sync
        limit = goal.request.command_timeout or self._timeout
        self._patience = CommandWatchdog(limit, frames_wait=self._sync_now != "realtime")
        self._show(self._session.start(self._road, self._seed))

    def _show(self, observation: Observation | None) -> None:
        """Publish a frame and wait for its answer, or hand over the result if the run has ended."""
        self._last = observation
        if observation is not None and self._road is not None:
            self._awaited = self._frames.publish(observation, self._road, self._run_start + observation.time)
            self._patience.sent(observation.step)
        self._hand_over_if_ended()

    def _on_command(self, message: DriveCommand) -> None:
        if self._goal is None or not self._session.driving:
            return
        if self._sync_now == "lockstep" and message.header.stamp != self._awaited.stamp:
            return
        try:
            command = messages.command_from_message(message)
        except CommandError as error:
            self._refused = f"; {messages.REFUSED}: {error}"
            self.get_logger().warning(f"command refused: {error}", throttle_duration_sec=1.0)
            return
        self._patience.heard()
        if self._sync_now == "realtime":
            self._real_time.hold(command)
        else:
            self._advance(command)

    def _advance(self, command: Command) -> None:
        if self._goal is None or not self._session.driving:
            return  # a frame of real time that was due when the run had just been ended
        observation = self._session.advance(command)
        if observation is not None and self._road is not None and observation.step % messages.FEEDBACK_EVERY == 0:
            self._goal.publish_feedback(messages.drive_feedback(observation, self._road))
        self._show(observation)

    def _watch(self) -> None:
        """End a run whose client gave up or whose driver says nothing."""
        if self._goal is None or not self._session.driving or self._last is None:
            return
        if self._goal.is_cancel_requested:
            self._finish(Outcome.CANCELLED, "cancelled by the client")
        elif self._patience.is_over:
            self._finish(Outcome.DRIVER_SILENT, f"no command within {self._patience.limit:g} s{self._refused}")
        elif self._patience.wants_repeat:
            self._show(self._last)

    def _finish(self, outcome: Outcome, message: str) -> None:
        self._session.end(outcome, message)
        self._hand_over_if_ended()

    def _hand_over_if_ended(self) -> None:
        if self._goal is not None and not self._session.driving and not self._handed_over:
            self._handed_over = True
            self._goal.execute()

    def _result(self, goal: ServerGoalHandle) -> DriveRoad.Result:
        """The ended run as the action's result."""
        self._goal, run = None, self._session.run
        assert run is not None
        run.message = "; ".join(filter(None, (run.message, self._real_time.end())))
        self._run_start += run.simulated_seconds + FRAME_TIME
        messages.close_goal(goal, run.outcome)
        self.get_logger().info(f"{run.road.road_id}: {run.outcome.name} after {run.steps} steps {run.message}".rstrip())
        return messages.drive_result(run)


def main(simulator: str = "bullet") -> None:
    """Host the simulator that the parameter names, or this one."""
    sys.exit(run_node(lambda: SimulatorNode(simulator)))


if __name__ == "__main__":
    main()
