# SPDX-License-Identifier: Apache-2.0
"""Requests to a node: goals of its actions, the road that is driven next, and why a request is refused."""

from __future__ import annotations

import math
import traceback
from collections.abc import Callable
from typing import Any

from ds_interfaces.action import DriveRoad
from ds_interfaces.srv import LoadRoad
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node

from ds_base.errors import InputError
from ds_road import Road, RoadError
from ds_sim.conditions.model import Conditions, ConditionsError, NotApplicableError
from ds_sim.messages import road_from_message
from ds_sim.ros.conversions import conditions_from_messages, refusal_result
from ds_sim.scenario import Scenario, ScenarioError
from ds_sim.simulator import Reason, SimulatorSpec

SYNC_MODES = (DriveRoad.Goal.SYNC_LOCKSTEP, DriveRoad.Goal.SYNC_FIRST, DriveRoad.Goal.SYNC_REALTIME)
"""lockstep: only the command with the stamp of the last image counts; first: the first command after the last image
counts; realtime: frames come at 20 Hz by the wall clock, and the last command is held."""


class RequestRefused(InputError):
    """A node does not accept a road or a goal: a reason for programs, and cause and remedy in one line."""

    def __init__(self, reason: Reason, message: str) -> None:
        super().__init__(message)
        self.reason = reason


def no_road() -> RequestRefused:
    """Make the refusal of a request that needs a loaded road."""
    return RequestRefused(Reason.NO_ROAD, "no road is loaded: call load_road first, or give one with the goal")


def check_goal(sync: str, command_timeout: float) -> None:
    """Refuse, as BAD_GOAL, options of a goal that cannot be; "" and 0 mean the node's parameters."""
    if sync not in ("", *SYNC_MODES):
        raise RequestRefused(Reason.BAD_GOAL, f"sync {sync!r}: expected one of {', '.join(SYNC_MODES)}")
    if not 0.0 <= command_timeout < math.inf:
        message = f"command_timeout {command_timeout}: expected seconds, or 0 for the node's own"
        raise RequestRefused(Reason.BAD_GOAL, message)


class LoadedRoad:
    """Stores the scenario that was loaded last, None before the first; tests that bring no conditions get the default.

    NotApplicableError if the simulator cannot realise that.
    """

    def __init__(self, spec: SimulatorSpec, default: Conditions) -> None:
        spec.check(default)
        self._spec, self._default = spec, default
        self.scenario: Scenario | None = None

    def load(self, request: LoadRoad.Request | DriveRoad.Goal) -> Road:
        """Check and store a test; RequestRefused for one that cannot be, which does not replace the stored one."""
        try:
            road = road_from_message(request.road)
            if not road.validity.valid:
                raise RoadError(f"the road is not valid: {road.validity.reason}")
            if request.default_conditions and request.conditions:
                raise ConditionsError("conditions, and default_conditions: expected one of both")
            has_conditions = request.conditions or request.default_conditions
            conditions = conditions_from_messages(request.conditions) if has_conditions else self._default
            self._spec.check(conditions)
            self.scenario = Scenario(road, conditions, seed=request.seed)
        except RoadError as error:
            raise RequestRefused(Reason.BAD_ROAD, str(error)) from None
        except NotApplicableError as error:
            raise RequestRefused(Reason.NOT_APPLICABLE, str(error)) from None
        except (ConditionsError, ScenarioError) as error:
            raise RequestRefused(Reason.BAD_GOAL, str(error)) from None
        return road


class GoalServer:
    """Action server that accepts every goal, and aborts a refused one at once, as a rejection cannot carry a reason.

    `begin` begins what a goal asks for or raises RequestRefused; `close` is called when that has ended.
    """

    def __init__(
        self,
        node: Node,
        kind: Any,
        name: str,
        begin: Callable[[ServerGoalHandle], None],
        on_cancel: Callable[[ServerGoalHandle], None] = lambda _goal: None,
    ) -> None:
        self._node, self._kind = node, kind
        self._begin, self._on_cancel = begin, on_cancel
        self._ends: dict[bytes, tuple[Any, Callable[[], None]]] = {}
        self._server = ActionServer(
            node,
            kind,
            name,
            execute_callback=self._execute,
            goal_callback=lambda _goal: GoalResponse.ACCEPT,
            handle_accepted_callback=self._accept,
            cancel_callback=self._cancel,
        )

    def close(self, goal: ServerGoalHandle, result: Any, final: Callable[[], None]) -> None:
        """Send the result of a goal; `final` sets its last state."""
        self._ends[bytes(goal.goal_id.uuid)] = result, final
        goal.execute()

    def _accept(self, goal: ServerGoalHandle) -> None:
        try:
            self._begin(goal)
        except RequestRefused as refused:
            self._node.get_logger().warning(f"goal refused: {refused}", throttle_duration_sec=10.0)
            self.close(goal, refusal_result(self._kind, refused.reason, str(refused)), goal.abort)
        except Exception as error:  # a bug here must not leave the client waiting
            self._node.get_logger().error(traceback.format_exc())
            problem = f"a bug of the node, its log has the traceback: {type(error).__name__}: {error}"
            self.close(goal, refusal_result(self._kind, Reason.NONE, problem), goal.abort)

    def _cancel(self, goal: ServerGoalHandle) -> CancelResponse:
        self._on_cancel(goal)
        return CancelResponse.ACCEPT

    def _execute(self, goal: ServerGoalHandle) -> Any:
        result, final = self._ends.pop(bytes(goal.goal_id.uuid))
        final()
        return result
