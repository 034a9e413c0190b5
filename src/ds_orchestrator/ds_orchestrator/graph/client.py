# SPDX-License-Identifier: Apache-2.0
"""Drives roads through a graph of ROS nodes; every wait has a limit."""

from __future__ import annotations

import itertools
import math
import os
import threading
import time
from dataclasses import replace
from typing import Any, cast

import rclpy
from action_msgs.msg import GoalStatus
from ds_interfaces.action import DriveRoad
from ds_interfaces.srv import GetSimulatorInfo
from rclpy.action import ActionClient
from rclpy.context import Context
from rclpy.node import Node
from std_srvs.srv import Trigger

from ds_base.errors import RunError
from ds_base.processes import RunningClock
from ds_base.progress import logger_of
from ds_driver.closed_loop.simulation import DriveRequest
from ds_orchestrator.campaign.engine import Watch
from ds_orchestrator.graph.supervisor import Supervisor
from ds_sim.registry import SimulatorName, spec_of
from ds_sim.ros import conversions as messages
from ds_sim.ros.neighbours import FEEDBACK, names_of
from ds_sim.ros.node_thread import NodeThread
from ds_sim.ros.runtime import init_ros
from ds_sim.scenario import Scenario
from ds_sim.session import RunRecord
from ds_sim.simulator import Outcome, Reason

LOG = logger_of(__name__)

SERVICE_TIME = 20.0
"""Limit for a simulator's answer to a service or a goal, s."""
START_TIME = 90.0
"""Limit for the start of a graph, s; includes importing libraries on a busy machine."""
ABSENT_TIME = 10.0
"""The same for a simulator that somebody else has to start, and that was awaited in vain before, s."""
BUSY_TIME = 25.0
"""Limit for another client's run to end, s; ROS discovery drops a killed client after 20 s."""
QUIET, UNANSWERED = 2.0, 3
"""Silence, s, after which a simulator that this process did not start is queried, and the number of unanswered queries
in a row after which it counts as dead; chosen: a dead node is reported in 10 s, within which a loaded one answers."""
ASK_AGAIN = 5.0
"""Silence, s, after which a run's result is requested again; chosen: a run gives feedback every second or so."""
QUERY_TIME = 2.5
"""Limit for the answer to such a query, s."""
_NUMBERS = itertools.count()


class GraphError(RunError):
    """Graph that does not start, or holds unexpected simulators."""


class GraphClient:
    """Drives roads through one graph, given the namespace of each simulator; an `Engine`.

    The domain is the environment's if it is None. A simulator waits `command_timeout` s of wall-clock time for its
    driver. The supervisor restarts dead processes before the next run; None to use running nodes.
    """

    def __init__(
        self,
        namespaces: dict[SimulatorName, str],
        *,
        domain: int | None,
        command_timeout: float,
        supervisor: Supervisor | None = None,
    ) -> None:
        self._timeout, self._supervisor = command_timeout, supervisor
        self._revival = threading.Lock()
        self._start_time = START_TIME
        # A separate context, because one process may drive several graphs, each in its own domain.
        self._context = Context()
        init_ros(context=self._context, domain_id=domain)
        # Several clients may take turns on one simulator and find each other by these names.
        self._node = Node(f"orchestrator_{os.getpid()}_{next(_NUMBERS)}", context=self._context)
        self._simulators = {name: _Simulator(self._node, name, space) for name, space in namespaces.items()}
        if supervisor is not None:
            for simulator in self._simulators.values():
                simulator.processes = supervisor.names_in(simulator.namespace)
        self._thread = NodeThread(self._node)

    @property
    def capacity(self) -> int | None:
        """None: each simulator takes one drive at a time."""
        return None

    @property
    def context(self) -> Context:
        """ROS context in the graph's domain, for further nodes of this process."""
        return self._context

    def wait_until_ready(self, limit: float = START_TIME, *, only: SimulatorName | None = None) -> None:
        """Wait until every simulator, or only one, answers and has a driver, at most `limit` seconds.

        GraphError says what is missing by then, ProcessError that a process of the supervisor ended.
        """
        if only is None:
            self._start_time = limit
        deadline, announced = time.monotonic() + limit, self._supervisor is not None or limit <= ABSENT_TIME
        awaited = [self._simulators[only]] if only else list(self._simulators.values())
        while missing := list(filter(None, (simulator.missing() for simulator in awaited))):
            if self._supervisor is not None:
                self._supervisor.check({process for simulator in awaited for process in simulator.processes})
            if not announced and time.monotonic() > deadline - limit + QUIET:
                announced = True
                LOG.info("%s: waiting %.0f s at most", missing[0], limit)
            if time.monotonic() > deadline:
                advice = "see the folder logs" if self._supervisor else "start it, in the same ROS domain"
                raise GraphError(f"after {limit:.0f} s {missing[0]}: {advice}")
            if self._thread.pause(0.05):
                return

    def check_simulators(self) -> None:
        """Check that every namespace holds the simulator that is expected there, and answers; else GraphError."""
        for name, simulator in self._simulators.items():
            actual, expected, namespace = self.info(name).name, spec_of(name).name, simulator.namespace
            if actual != expected:
                raise GraphError(f"{namespace} is {actual}, expected {expected}: start it under another namespace")

    def info(self, simulator: SimulatorName) -> GetSimulatorInfo.Response:
        """Ask a simulator's node for its description; GraphError if it does not answer."""
        response = self._thread.ask(self._simulators[simulator].info, GetSimulatorInfo.Request(), SERVICE_TIME)
        if response is None:
            raise GraphError(f"{simulator} does not answer get_info within {SERVICE_TIME:.0f} s: is its node alive?")
        return response

    def execute(
        self,
        simulator: SimulatorName,
        scenario: Scenario,
        *,
        conditions_of_node: bool = False,
        watch: Watch | None = None,
    ) -> RunRecord:
        """Drive a scenario on a simulator; always returns, and never raises for an error in another process.

        With `conditions_of_node`, the operating conditions of the simulator's node take the place of default ones;
        `watch` is called from another thread with the simulator's feedback.
        """
        one = self._simulators[simulator]
        one.watch = watch
        # The goal carries the whole test, so that another client's load_road cannot interfere.
        goal = DriveRoad.Goal(
            road=messages.road_to_message(scenario.road),
            seed=scenario.seed,
            conditions=messages.conditions_to_messages(scenario.conditions),
            default_conditions=scenario.conditions.is_default and not conditions_of_node,
            command_timeout=self._timeout,
        )
        while True:
            record = RunRecord(scenario=scenario)
            self._revive()
            began = time.monotonic()
            record.outcome, record.message = self._execute(one, record, goal)
            if record.commands and one.renewed < began:
                one.starting = False
            if not (record.outcome is Outcome.DRIVER_SILENT and self._waits_for(one, began, record)):
                break
        if self._thread.stopped and record.outcome.is_error:
            record.outcome = Outcome.CANCELLED
        return record

    def drive(self, request: DriveRequest, watch: Watch | None = None) -> RunRecord:
        """See `ds_orchestrator.campaign.engine.Engine`; the driver is that of the graph's nodes."""
        return self.execute(request.simulator, request.scenario, watch=watch)

    def stop(self) -> None:
        """End every wait now; active runs end as CANCELLED."""
        self._thread.stop()

    def close(self) -> None:
        """Destroy the node and its clients."""
        # Without destroying its node, a context stays visible in its domain until this process ends.
        if self._thread.end():
            for simulator in self._simulators.values():
                simulator.drive.destroy()
            self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    def _restart(self, simulator: _Simulator, began: float = math.inf) -> None:
        """Restart a simulator and its driver if the supervisor runs them, unless restarted after this time."""
        if self._supervisor is None or self._thread.stopped:
            return
        with self._revival:
            if simulator.renewed < began:
                for process in simulator.processes:
                    self._supervisor.restart(process)
                simulator.note_restart()

    def _revive(self) -> None:
        """Restart every process of the supervisor that has ended."""
        if self._supervisor is not None:
            with self._revival:
                revived = set(self._supervisor.revive())
                for simulator in self._simulators.values():
                    if revived & simulator.processes:
                        simulator.note_restart()

    def _waits_for(self, simulator: _Simulator, began: float, record: RunRecord) -> bool:
        """Check whether a restarted driver is still starting; discovery may still list the old one's publisher."""
        renewed = simulator.renewed
        patient = simulator.starting and began - renewed < START_TIME and not self._thread.stopped
        # A run from before the new driver, or one that the new driver answered in any way, keeps its outcome.
        answered = bool(record.commands) or record.reason is Reason.COMMAND_REFUSED
        return patient and renewed < began and not answered

    def _execute(self, simulator: _Simulator, record: RunRecord, goal: DriveRoad.Goal) -> tuple[Outcome, str]:
        began = time.monotonic()
        try:
            self.wait_until_ready(ABSENT_TIME if simulator.absent else self._start_time, only=simulator.name)
            simulator.absent = False
        except GraphError as error:  # it stopped between two runs
            simulator.absent = self._supervisor is None
            self._restart(simulator, began)
            return Outcome.SIM_ERROR, str(error)
        except RuntimeError as error:
            return Outcome.SIM_ERROR, str(error)
        # A goal must not be sent twice, but a service may be called until a simulator that has just started answers.
        limit = START_TIME if simulator.starting else SERVICE_TIME
        if self._thread.ask(simulator.info, GetSimulatorInfo.Request(), limit) is None:
            self._restart(simulator)
            return Outcome.SIM_ERROR, f"get_info was not answered within {limit:.0f} s"
        result = self._drive(simulator, goal)
        if isinstance(result, str):
            return Outcome.SIM_ERROR, result
        try:
            _fill(record, result)
        except ValueError as error:
            return Outcome.SIM_ERROR, f"the result makes no sense: {error}"
        outcome = Outcome(result.outcome.value)
        hangs = outcome is Outcome.DRIVER_SILENT and record.reason is not Reason.COMMAND_REFUSED
        if hangs and not self._waits_for(simulator, began, record):
            self._restart(simulator, began)
        return outcome, result.message

    def _drive(self, simulator: _Simulator, goal: DriveRoad.Goal) -> DriveRoad.Result | str:
        """Send a goal and return its result, or one line on the error.

        Waits for a simulator that drives for another client, and ends a run that lost its client.
        """
        deadline, reported = time.monotonic() + BUSY_TIME, False
        while True:
            result = self._drive_once(simulator, goal)
            if isinstance(result, str) or result.reason.value != Reason.BUSY:
                return result
            others = simulator.other_clients()
            if not others:
                self._thread.ask(simulator.reset, Trigger.Request(), SERVICE_TIME)
            elif not reported:
                reported = True
                LOG.info("%s drives for %s: waiting %.0f s at most", simulator.namespace, ", ".join(others), BUSY_TIME)
            if time.monotonic() > deadline or self._thread.pause(0.5 if others else 0.2):
                return result

    def _drive_once(self, simulator: _Simulator, goal: DriveRoad.Goal) -> DriveRoad.Result | str:
        simulator.alive, simulator.frame = simulator.clock.now(), 0
        handle = self._thread.call(lambda: simulator.drive.send_goal_async(goal, simulator.on_feedback), SERVICE_TIME)
        if handle is None:
            self._restart(simulator)
            return f"the goal was not answered within {SERVICE_TIME:.0f} s"
        if not handle.accepted:
            return "the goal was rejected: is this simulator of another version?"
        result = self._await_result(simulator, handle)
        if isinstance(result, str):
            return result
        if result is not None and result.status == GoalStatus.STATUS_UNKNOWN:  # of a node that never had the goal
            return f"the simulator was started anew during the run, {simulator.place}"
        if result is not None:
            return cast(DriveRoad.Result, result.result)
        if handle.status in (GoalStatus.STATUS_ACCEPTED, GoalStatus.STATUS_EXECUTING, GoalStatus.STATUS_UNKNOWN):
            self._thread.call(handle.cancel_goal_async, 1.0)
        self._restart(simulator)
        if self._supervisor is None and not self._thread.stopped:
            seconds = simulator.clock.now() - simulator.alive
            return f"{simulator.name} has not answered for {seconds:.0f} s, {simulator.place}: is its node alive?"
        return f"the simulator fell silent during the run, {simulator.place}"

    def _await_result(self, simulator: _Simulator, handle: Any) -> Any:
        """Wait for the result of a goal; None after too long a silence, one line if its process ended."""
        future = self._thread.send(handle.get_result_async, SERVICE_TIME)
        if future is None:
            return None
        # A slow driver may use the whole timeout for every frame between two feedback messages.
        silence = messages.FEEDBACK_EVERY * self._timeout + SERVICE_TIME
        asked = simulator.clock.now()
        while not future.done():
            now = simulator.clock.now()
            if self._thread.stopped or now - simulator.alive > silence:
                return None
            # A result that comes while neither node knows the other is lost.
            if now - max(asked, simulator.alive) > ASK_AGAIN:
                asked, future = now, self._thread.send(handle.get_result_async, SERVICE_TIME) or future
            if self._supervisor is not None and (dead := simulator.processes & set(self._supervisor.dead())):
                return f"{', '.join(sorted(dead))} ended during the run, {simulator.place}"
            self._thread.wait(future, 0.5)
            if self._supervisor is None and not future.done() and not self._answers(simulator):
                return None
        return future.result()

    def _answers(self, simulator: _Simulator) -> bool:
        """Check whether a simulator that this process did not start gives feedback or answers a query."""
        if simulator.clock.now() - max(simulator.alive, simulator.answered) < QUIET:
            return True
        request = GetSimulatorInfo.Request()
        for _ in range(UNANSWERED):
            asked = simulator.clock.now()
            if self._thread.call(lambda: simulator.info.call_async(request), QUERY_TIME) is not None:
                simulator.answered = simulator.clock.now()
                return True
            if self._thread.stopped or simulator.alive > asked:
                return True
        return False


class _Simulator:
    """Clients of one simulator's node."""

    def __init__(self, node: Node, name: SimulatorName, namespace: str) -> None:
        self._node, self.name, self.namespace = node, name, namespace
        self.info = node.create_client(GetSimulatorInfo, f"{namespace}/get_info")
        self.reset = node.create_client(Trigger, f"{namespace}/reset")
        self.drive = ActionClient(node, DriveRoad, f"{namespace}/drive_road")
        self.frame = 0
        """Last frame of the run that feedback was about."""
        self.clock = RunningClock()
        self.alive = 0.0
        """Time of the last feedback by this clock, s."""
        self.answered = 0.0
        """Time of the last answer to a query during a run, s."""
        self.watch: Watch | None = None
        self.processes: set[str] = set()
        """Names of the supervisor's processes with it and its driver: usually one."""
        self.renewed = -math.inf
        """Monotonic time of the last restart of it or its driver, s."""
        self.starting = False
        """Whether it was restarted, and its driver has not answered yet."""
        self.absent = False
        """Whether this process did not start it, and awaited it in vain."""

    def note_restart(self) -> None:
        """Remember that it was restarted now."""
        self.renewed, self.starting = time.monotonic(), True

    def on_feedback(self, message: Any) -> None:
        """Record a sign of life, and pass the feedback on."""
        feedback = message.feedback
        self.alive, self.frame = self.clock.now(), feedback.step
        if self.watch is not None:
            self.watch(feedback.step, feedback.progress, feedback.lateral_position)

    @property
    def place(self) -> str:
        """Where the run was when it was last heard of."""
        return f"after frame {self.frame} (feedback comes every {messages.FEEDBACK_EVERY} frames)"

    def other_clients(self) -> list[str]:
        """Names of other nodes with a client of the simulator's action."""
        own = self._node.get_fully_qualified_name()
        subscriptions = self._node.get_subscriptions_info_by_topic(f"{self.namespace}/{FEEDBACK}")
        return [name for name in names_of(subscriptions) if name != own]

    def missing(self) -> str:
        """Describe in one line what is missing for a run; "" if nothing is."""
        if not (self.info.service_is_ready() and self.drive.server_is_ready()):
            return f"there is no simulator in {self.namespace}"
        if not self._node.count_publishers(f"{self.namespace}/drive"):
            return f"there is no driver for {self.namespace}"
        return ""


def _fill(record: RunRecord, result: DriveRoad.Result) -> None:
    """Copy a simulator's result into a record; ValueError for one that no run ends with."""
    if result.outcome.value == Outcome.RUNNING:
        raise ValueError("it says that the run goes on")
    record.reason = Reason(result.reason.value)
    record.observations = messages.observations_of(result.trajectory)
    record.commands = messages.commands_of(result.trajectory)
    if record.observations:
        conditions = messages.conditions_from_messages(result.conditions)
        record.scenario = replace(record.scenario, conditions=conditions)
