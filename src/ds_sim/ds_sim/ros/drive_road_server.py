"""Serves the action `drive_road`, and states why a goal is refused."""

from __future__ import annotations

from collections.abc import Callable

from ds_interfaces.action import DriveRoad
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node

from ds_sim.ros.conversions import refusal_result
from ds_sim.ros.loaded_road import RequestRefused


class DriveRoadServer:
    """Accepts every goal; aborts a refused one at once, as a rejection cannot carry a reason.

    Args:
        node: node that owns the server.
        begin: begins the run of a goal or raises RequestRefused; calls `execute` of the goal when the run has ended.
        result: closes a goal whose run has ended, and returns its result.
    """

    def __init__(
        self,
        node: Node,
        begin: Callable[[ServerGoalHandle], None],
        result: Callable[[ServerGoalHandle], DriveRoad.Result],
    ) -> None:
        self._node = node
        self._begin, self._result = begin, result
        self._refused: dict[bytes, RequestRefused] = {}
        self._server = ActionServer(
            node,
            DriveRoad,
            "drive_road",
            execute_callback=self._execute,
            goal_callback=lambda _goal: GoalResponse.ACCEPT,
            handle_accepted_callback=self._accept,
            cancel_callback=lambda _goal: CancelResponse.ACCEPT,
        )

    def _accept(self, goal: ServerGoalHandle) -> None:
        try:
            self._begin(goal)
        except RequestRefused as refused:
            self._node.get_logger().warning(f"goal refused: {refused}", throttle_duration_sec=10.0)
            self._refused[bytes(goal.goal_id.uuid)] = refused
            goal.execute()

    def _execute(self, goal: ServerGoalHandle) -> DriveRoad.Result:
        refused = self._refused.pop(bytes(goal.goal_id.uuid), None)
        if refused is None:
            return self._result(goal)
        goal.abort()
        return refusal_result(refused.reason, str(refused))
