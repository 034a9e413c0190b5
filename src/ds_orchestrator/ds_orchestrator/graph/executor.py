"""The orchestrator's ROS side: finds the simulators of a graph and drives roads on them, with a limit on every wait."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import rclpy
from action_msgs.msg import GoalStatus
from ds_interfaces.action import DriveRoad
from ds_interfaces.srv import GetSimulatorInfo, LoadRoad
from rclpy.action import ActionClient
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from std_srvs.srv import Trigger

from ds_orchestrator.graph.process_specs import DRIVER_PROCESS, simulator_process_name
from ds_orchestrator.graph.supervisor import Supervisor
from ds_road import Road
from ds_sim.registry import spec_of
from ds_sim.ros import conversions as messages
from ds_sim.session import RunRecord
from ds_sim.simulator import Observation, Outcome

SERVICE_TIME = 20.0
"""Seconds that a simulator gets to answer a service or a goal."""
ATTEMPTS = 10
"""Calls of a service within that time: one that goes to a process that just died is never answered."""
START_TIME = 90.0
"""Seconds that a graph gets to come up, importing its libraries on a busy machine included."""
_NO_IMAGE = np.empty((0, 0, 3), np.uint8)


class GraphError(RuntimeError):
    """A graph that does not come up."""


class GraphExecutor:
    """Drives roads through the graph; satisfies `ds_orchestrator.campaign.runner.Executor`.

    Args:
        namespaces: simulator name -> its namespace.
        domain: ROS domain; None for the environment's.
        command_timeout: s that a simulator waits for its driver.
        supervisor: of the processes, if they are ours; a dead one is started again before the next run.
    """

    def __init__(
        self,
        namespaces: dict[str, str],
        *,
        domain: int | None,
        command_timeout: float,
        supervisor: Supervisor | None = None,
    ) -> None:
        self._namespaces = dict(namespaces)
        self._timeout = command_timeout
        self._supervisor = supervisor
        self._revival = threading.Lock()
        self._driver_renewed, self._driver_starts = -math.inf, False
        self._stopped = threading.Event()
        # A context of its own, because several graphs, each in its domain, may be driven by one process.
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
        self._node = Node("orchestrator", context=self._context)
        self._simulators = {name: _Simulator(self._node, space) for name, space in namespaces.items()}
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._spinner = threading.Thread(target=self._spin, name="spinner", daemon=True)
        self._spinner.start()

    @property
    def context(self) -> Context:
        """Of the graph's domain, for further nodes of this process."""
        return self._context

    def wait_until_ready(self, limit: float = START_TIME, *, only: str | None = None) -> None:
        """Wait until every simulator, or only one, answers and has a driver.

        Raises:
            GraphError: the time is up; says what is missing.
            ds_orchestrator.graph.supervisor.ProcessError: one of our processes ended.
        """
        deadline = time.monotonic() + limit
        awaited = [only] if only else list(self._simulators)
        while missing := [m for name in awaited if (m := self._simulators[name].missing())]:
            if self._supervisor is not None:
                self._supervisor.check({p for name in awaited for p in self._processes(name)})
            if time.monotonic() > deadline:
                raise GraphError(f"after {limit:.0f} s {missing[0]}: start it, in the same ROS domain")
            if self._stopped.wait(0.05):
                return

    def check_simulators(self) -> None:
        """Find out whether every namespace holds the simulator that its name promises.

        Raises:
            GraphError: it holds another one, or does not answer.
        """
        for name, namespace in self._namespaces.items():
            found, expected = self.info(name).name, spec_of(name).name
            if found != expected:
                raise GraphError(f"{namespace} is {found}, expected {expected}: start it under another namespace")

    def info(self, simulator: str) -> GetSimulatorInfo.Response:
        """What a simulator tells about itself.

        Raises:
            GraphError: it does not answer.
        """
        response = self._ask(self._simulators[simulator].info, GetSimulatorInfo.Request())
        if response is None:
            raise GraphError(f"{simulator} does not answer get_info within {SERVICE_TIME:.0f} s: is its node alive?")
        return response

    def execute(self, simulator: str, road: Road, seed: int) -> RunRecord:
        """Drive a road on a simulator; always ends, and never raises for what goes wrong in another process."""
        while True:
            record = RunRecord(road=road, seed=seed)
            self._revive()
            began = time.monotonic()
            outcome, message = self._execute(simulator, record)
            if record.commands and self._driver_renewed < began:
                self._driver_starts = False
            if not (outcome is Outcome.DRIVER_SILENT and self._waits_for_driver(began, message, record)):
                break
        record.outcome, record.message = outcome, message
        if self._stopped.is_set() and outcome.is_error:
            record.outcome = Outcome.CANCELLED
        return record

    def stop(self) -> None:
        """Let every wait return now; runs under way end as CANCELLED."""
        self._stopped.set()

    def close(self) -> None:
        """Leave the graph."""
        self.stop()
        rclpy.try_shutdown(context=self._context)
        self._spinner.join(2.0)

    def _processes(self, simulator: str) -> set[str]:
        """The processes of ours that a run on a simulator needs."""
        return {simulator_process_name(self._namespaces[simulator]), DRIVER_PROCESS}

    def _restart(self, simulator: str) -> None:
        """A simulator of ours that no longer answers gets a new process."""
        if self._supervisor is not None and not self._stopped.is_set():
            with self._revival:
                self._supervisor.restart(simulator_process_name(self._namespaces[simulator]))

    def _revive(self) -> None:
        """Start every process of ours that has ended."""
        if self._supervisor is not None:
            with self._revival:
                if DRIVER_PROCESS in self._supervisor.revive():
                    self._driver_renewed, self._driver_starts = time.monotonic(), True

    def _waits_for_driver(self, began: float, message: str, record: RunRecord) -> bool:
        """A new driver of ours has not come up yet; the graph may still count the publisher of the old one."""
        patient = self._driver_starts and began - self._driver_renewed < START_TIME and not self._stopped.is_set()
        # A run of before the new driver, or one that the new driver answered in whatever way, is as it is.
        return patient and self._driver_renewed < began and not record.commands and messages.REFUSED not in message

    def _renew_driver(self, began: float, message: str, record: RunRecord) -> None:
        """A driver of ours that hangs gets a new process.

        It drives the other simulators too, and their runs fall silent with the old process: that is no reason to
        start a third one. One that talks nonsense does not hang.
        """
        if self._supervisor is None or self._stopped.is_set() or DRIVER_PROCESS not in self._supervisor.names:
            return
        if messages.REFUSED in message or self._waits_for_driver(began, message, record):
            return
        with self._revival:
            if self._driver_renewed < began:
                self._supervisor.restart(DRIVER_PROCESS)
                self._driver_renewed, self._driver_starts = time.monotonic(), True

    def _execute(self, name: str, record: RunRecord) -> tuple[Outcome, str]:
        simulator = self._simulators[name]
        began = time.monotonic()
        try:
            self.wait_until_ready(START_TIME, only=name)
        except (GraphError, RuntimeError) as error:
            return Outcome.SIM_ERROR, str(error)
        loaded = self._load(simulator, record)
        if loaded is None:
            self._restart(name)
            return Outcome.SIM_ERROR, f"load_road was not answered within {SERVICE_TIME:.0f} s"
        if not loaded.accepted:
            return Outcome.SIM_ERROR, f"road refused: {loaded.reason}"
        simulator.alive = time.monotonic()
        goal = DriveRoad.Goal(command_timeout=self._timeout)
        handle = self._call(lambda: simulator.drive.send_goal_async(goal, simulator.heard), SERVICE_TIME)
        if handle is None or not handle.accepted:
            return Outcome.SIM_ERROR, "the goal was not accepted: is another run under way?"
        result = self._await_result(name, handle)
        if result is None:
            if handle.status in (GoalStatus.STATUS_ACCEPTED, GoalStatus.STATUS_EXECUTING, GoalStatus.STATUS_UNKNOWN):
                self._call(handle.cancel_goal_async, 1.0)
            if self._supervisor is not None and (dead := self._processes(name) & set(self._supervisor.dead())):
                return Outcome.SIM_ERROR, f"{', '.join(sorted(dead))} ended during the run"
            self._restart(name)
            return Outcome.SIM_ERROR, "the simulator fell silent during the run"
        _fill(record, result.result)
        if Outcome(result.result.outcome.value) is Outcome.DRIVER_SILENT:
            self._renew_driver(began, result.result.message, record)
        return Outcome(result.result.outcome.value), result.result.message

    def _load(self, simulator: _Simulator, record: RunRecord) -> LoadRoad.Response | None:
        """Load a road; a run that is under way, such as one whose client died, is ended first."""
        request = LoadRoad.Request(road=messages.road_to_message(record.road), seed=record.seed)
        deadline = time.monotonic() + SERVICE_TIME
        while True:
            loaded: LoadRoad.Response | None = self._ask(simulator.load, request)
            if loaded is None or loaded.accepted or loaded.reason != messages.BUSY or time.monotonic() > deadline:
                return loaded
            self._ask(simulator.reset, Trigger.Request())
            if self._stopped.wait(0.2):
                return loaded

    def _await_result(self, name: str, handle: Any) -> Any:
        """Wait for a result for as long as the simulator shows signs of life."""
        future = self._wait(self._executor.create_task(handle.get_result_async), SERVICE_TIME)
        if future is None:
            return None
        simulator = self._simulators[name]
        # A slow driver may take its whole time for every frame until the simulator tells of its progress.
        silence = messages.FEEDBACK_EVERY * self._timeout + SERVICE_TIME
        while not future.done():
            if self._stopped.is_set() or time.monotonic() - simulator.alive > silence:
                return None
            if self._supervisor is not None and self._processes(name) & set(self._supervisor.dead()):
                return None
            self._wait(future, 0.5)
        return future.result()

    def _ask(self, client: Any, request: Any) -> Any:
        """The answer of a service that may be asked again, or None."""
        for _ in range(ATTEMPTS):
            answer = self._call(lambda: client.call_async(request), SERVICE_TIME / ATTEMPTS)
            if answer is not None or self._stopped.is_set():
                return answer
        return None

    def _call(self, begin: Callable[[], Future], limit: float) -> Any:
        """The answer to a request, or None when the time is up or we were stopped.

        It is sent by the spinner's thread: rclpy's action client has no lock, and an answer that comes before the
        request is noted down is thrown away.
        """
        deadline = time.monotonic() + limit
        begun = self._wait(self._executor.create_task(begin), limit)
        return None if begun is None else self._wait(begun, max(0.0, deadline - time.monotonic()))

    def _wait(self, future: Future, limit: float) -> Any:
        """A future's result, or None when the time is up or we were stopped."""
        ready = threading.Event()
        future.add_done_callback(lambda _future: ready.set())
        deadline = time.monotonic() + limit
        while not ready.wait(min(0.1, max(0.0, deadline - time.monotonic()))):
            if self._stopped.is_set() or time.monotonic() >= deadline:
                return None
        return future.result()

    def _spin(self) -> None:
        try:
            while rclpy.ok(context=self._context):
                self._executor.spin_once(timeout_sec=0.2)
        except ExternalShutdownException:
            pass


class _Simulator:
    """The clients of one simulator's node."""

    def __init__(self, node: Node, namespace: str) -> None:
        self._node = node
        self._namespace = namespace
        self.load = node.create_client(LoadRoad, f"{namespace}/load_road")
        self.info = node.create_client(GetSimulatorInfo, f"{namespace}/get_info")
        self.reset = node.create_client(Trigger, f"{namespace}/reset")
        self.drive = ActionClient(node, DriveRoad, f"{namespace}/drive_road")
        self.alive = 0.0

    def heard(self, _feedback: Any) -> None:
        """The simulator shows a sign of life."""
        self.alive = time.monotonic()

    def missing(self) -> str:
        """What is not there yet, or ""."""
        if not (self.load.service_is_ready() and self.info.service_is_ready() and self.drive.server_is_ready()):
            return f"there is no simulator in {self._namespace}"
        if not self._node.count_publishers(f"{self._namespace}/drive"):
            return f"there is no driver for {self._namespace}"
        return ""


def _fill(record: RunRecord, result: DriveRoad.Result) -> None:
    """Take over what a simulator reports of a run."""
    for state in result.states:
        vehicle, lane, outcome = messages.state_from_message(state)
        record.observations.append(
            Observation(
                image=_NO_IMAGE,
                step=state.step,
                time=state.simulated_time,
                vehicle=vehicle,
                lane=lane,
                outcome=outcome,
            )
        )
    record.commands.extend(messages.command_from_message(command) for command in result.commands)
