"""The ROS node that hosts any simulator: services to load a road, an action to drive it, lock-step by image stamp."""

from __future__ import annotations

import sys
import time

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from ds_interfaces.action import DriveRoad
from ds_interfaces.msg import DriveCommand, VehicleState
from ds_interfaces.msg import Outcome as OutcomeMsg
from ds_interfaces.srv import GetSimulatorInfo, LoadRoad
from ds_road import Road, RoadError
from ds_sim import messages
from ds_sim.registry import make_simulator
from ds_sim.ros_runtime import run_node
from ds_sim.session import Session
from ds_sim.simulator import FRAME_TIME, CommandError, Observation, Outcome, SimulatorError
from nav_msgs.msg import Odometry
from sensor_msgs.msg import CameraInfo, Image
from visualization_msgs.msg import MarkerArray

SYNC_MODES = ("lockstep", "first")
FEEDBACK_EVERY = 10
"""Frames between two feedback messages: twice a simulated second."""


class SimulatorNode(Node):
    """Publishes a frame, and takes no step until the command with that frame's stamp has come.

    Args:
        simulator: default of the parameter `simulator`.
    """

    def __init__(self, simulator: str = "bullet") -> None:
        super().__init__("simulator")
        name = self.declare_parameter("simulator", simulator).value
        self._sync = self.declare_parameter("sync", "lockstep").value
        self._timeout = self.declare_parameter("command_timeout", 5.0).value
        if self._sync not in SYNC_MODES:
            raise ValueError(f"parameter sync is {self._sync!r}: expected one of {', '.join(SYNC_MODES)}")
        if not self._timeout > 0.0:
            raise ValueError(f"parameter command_timeout is {self._timeout}: expected seconds above 0")
        self._session = Session(make_simulator(name))
        self._road: Road | None = None
        self._seed = 0
        self._goal: ServerGoalHandle | None = None
        self._goal_timeout, self._goal_sync = self._timeout, self._sync
        # Stamps never go back over the life of the node, as tf, bags and filters expect of a clock.
        self._run_start = 0.0
        self._awaited = Header()
        self._sent_at = 0.0
        self._refused = ""

        self._image = self.create_publisher(Image, "camera/image_raw", 5)
        self._info = self.create_publisher(CameraInfo, "camera/camera_info", 5)
        self._state = self.create_publisher(VehicleState, "state", 50)
        self._odom = self.create_publisher(Odometry, "odom", 50)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._markers = self.create_publisher(MarkerArray, "road_markers", latched)
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
        self.create_timer(0.05, self._watch)
        self.get_logger().info(f"{name} is ready in {self.get_namespace()}")

    def destroy_node(self) -> None:
        """Close the simulator with the node."""
        self._session.simulator.close()
        super().destroy_node()

    def _on_get_info(
        self, _request: GetSimulatorInfo.Request, response: GetSimulatorInfo.Response
    ) -> GetSimulatorInfo.Response:
        return messages.info_response(self._session.simulator.spec, response)

    def _on_load_road(self, request: LoadRoad.Request, response: LoadRoad.Response) -> LoadRoad.Response:
        try:
            if self._session.driving:
                raise RoadError("a run is under way: wait for its result or cancel it")
            road = messages.road_from_message(request.road)
            self._load(road, request.seed)
        except (RoadError, SimulatorError) as error:
            response.reason = str(error)
            self.get_logger().warning(f"road refused: {error}")
            return response
        response.accepted = True
        response.road_id = road.road_id
        response.length = road.length
        return response

    def _on_reset(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._road is None:
            response.message = "no road is loaded: call load_road first"
            return response
        self._finish(Outcome.CANCELLED, "reset was called")
        self._load(self._road, self._seed)
        response.success = True
        return response

    def _load(self, road: Road, seed: int) -> None:
        """Check a road and keep it; each run builds its world anew."""
        if not road.validity.valid:
            raise RoadError(road.validity.reason)
        self._road, self._seed = road, seed
        look = self._session.simulator.spec.look
        self._markers.publish(messages.road_markers(road, look, messages.to_time(self._run_start)))

    def _on_goal(self, goal: DriveRoad.Goal) -> GoalResponse:
        try:
            if self._goal is not None:
                raise RoadError("a run is under way: wait for its result or cancel it")
            if goal.sync not in ("", *SYNC_MODES):
                raise RoadError(f"sync {goal.sync!r}: expected one of {', '.join(SYNC_MODES)}")
            if goal.road.control_points:
                self._load(messages.road_from_message(goal.road), goal.seed)
            if self._road is None:
                raise RoadError("no road is loaded: call load_road first, or give one with the goal")
        except RoadError as error:
            self.get_logger().warning(f"goal refused: {error}")
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _on_accepted(self, goal: ServerGoalHandle) -> None:
        """Begin the run; the goal is executed, in the action's sense, when the run has ended."""
        assert self._road is not None
        request: DriveRoad.Goal = goal.request
        self._goal = goal
        self._goal_timeout = request.command_timeout or self._timeout
        self._goal_sync = request.sync or self._sync
        self._refused = ""
        first = self._session.start(self._road, self._seed)
        if first is not None:
            self._publish(first)
        self._hand_over_if_ended()

    def _publish(self, observation: Observation) -> None:
        header = Header(
            stamp=messages.to_time(self._run_start + observation.time),
            frame_id=f"{self.get_namespace().strip('/')}/camera".strip("/"),
        )
        self._awaited = header
        self._sent_at = time.monotonic()
        assert self._road is not None
        self._state.publish(messages.state_to_message(observation, header, self._road.road_id))
        self._image.publish(messages.image_to_message(observation, header))
        if self._info.get_subscription_count():
            self._info.publish(messages.camera_info_message(self._session.simulator.spec.camera, header))
        if self._odom.get_subscription_count():
            child = f"{self.get_namespace().strip('/')}/base_link".strip("/")
            self._odom.publish(messages.odometry_message(observation.vehicle, header, child))

    def _on_command(self, message: DriveCommand) -> None:
        if not self._session.driving:
            return
        if self._goal_sync == "lockstep" and message.header.stamp != self._awaited.stamp:
            return
        try:
            command = messages.command_from_message(message)
        except CommandError as error:
            self._refused = str(error)
            self.get_logger().warning(f"command refused: {error}", throttle_duration_sec=1.0)
            return
        observation = self._session.advance(command)
        if observation is not None:
            self._publish(observation)
            if self._goal is not None and self._road is not None and observation.step % FEEDBACK_EVERY == 0:
                self._goal.publish_feedback(
                    DriveRoad.Feedback(
                        step=observation.step,
                        progress=min(max(observation.lane.arc_length / self._road.length, 0.0), 1.0),
                        lateral_position=observation.lane.lateral_position,
                    )
                )
        self._hand_over_if_ended()

    def _watch(self) -> None:
        """End a run whose client gave up or whose driver says nothing."""
        if self._goal is None or not self._session.driving:
            return
        if self._goal.is_cancel_requested:
            self._finish(Outcome.CANCELLED, "cancelled by the client")
        elif time.monotonic() - self._sent_at > self._goal_timeout:
            reason = f"; the last command was refused: {self._refused}" if self._refused else ""
            self._finish(Outcome.DRIVER_SILENT, f"no command within {self._goal_timeout:g} s{reason}")

    def _finish(self, outcome: Outcome, message: str) -> None:
        self._session.end(outcome, message)
        self._hand_over_if_ended()

    def _hand_over_if_ended(self) -> None:
        if self._goal is not None and not self._session.driving:
            self._goal.execute()

    def _result(self, goal: ServerGoalHandle) -> DriveRoad.Result:
        """The ended run as the action's result."""
        run = self._session.run
        assert run is not None
        self._goal = None
        self._run_start += run.simulated_seconds + FRAME_TIME
        if run.outcome is Outcome.CANCELLED and goal.is_cancel_requested:
            goal.canceled()
        elif run.outcome.is_error:
            goal.abort()
        else:
            goal.succeed()
        self.get_logger().info(f"{run.road.road_id}: {run.outcome.name} after {run.steps} steps {run.message}".rstrip())
        return messages.drive_result(run)


def main(simulator: str = "bullet") -> None:
    """Host the simulator that the parameter names."""
    sys.exit(run_node(lambda: SimulatorNode(simulator)))


if __name__ == "__main__":
    main()
