# SPDX-License-Identifier: Apache-2.0
"""Executes tests on simulators: takes known outcomes from the store, and drives what is missing with an engine."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from itertools import zip_longest
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ds_base.errors import RunError
from ds_driver.closed_loop.simulation import DriveRequest
from ds_driver.networks.driver_name import AUTOPILOT, DriverName
from ds_orchestrator.campaign.engine import DriveSettings, Engine, Watch
from ds_orchestrator.store import rows
from ds_orchestrator.store.model import DriveArrays, Execution, Test
from ds_orchestrator.store.store import Store
from ds_sim.conditions.model import NotApplicableError
from ds_sim.gates.gate import Gate, exclusion_of, gate_of, not_applicable
from ds_sim.registry import SimulatorName, label_of, spec_of
from ds_sim.session import RunRecord

PATIENCE = 5
"""A simulator counts as broken after this many consecutive tests without an outcome, retries included; chosen: two or
three may be coincidence."""


class Stopped(Exception):
    """Campaign that was stopped by request."""


class StopSwitch:
    """Ends drives at the request of another thread, also if they have not begun yet."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._ends: list[Callable[[], None]] = []
        self.is_on = False

    def turn_on(self) -> None:
        """End what is connected, and whatever will be."""
        with self._lock:
            self.is_on = True
            for end in self._ends:
                end()

    def connect(self, *ends: Callable[[], None]) -> None:
        """Call these as soon as the switch is on."""
        with self._lock:
            self._ends += ends
            for end in ends if self.is_on else ():
                end()


class CampaignError(RunError):
    """Campaign that cannot continue because a simulator is broken."""


class Listener:
    """Callbacks on a campaign's progress, called from several threads; this one ignores every event."""

    def stage(self, name: str) -> None:
        """Handle the start of a stage."""

    def expect(self, stages: Sequence[Mapping[SimulatorName, int]]) -> None:
        """Handle the expected executions: per stage, simulator -> their number, finished ones included."""

    def finished(self, test: Test, simulator: SimulatorName, execution: Execution | Gate | None, fresh: bool) -> None:
        """Handle the end of an execution.

        Args:
            test: test that was driven.
            simulator: on which.
            execution: outcome; why the test is excluded there; or None if every attempt ended in an error.
            fresh: False if the execution was read from the store.
        """

    def driving(self, request: DriveRequest) -> AbstractContextManager[Watch | None]:
        """Enter a drive of the driver; what is yielded, if anything, gets its feedback."""
        return nullcontext()


class NoOutcomeError(RunError):
    """Every attempt ended in an error, which says nothing about the test; `run` is the last one."""

    def __init__(self, run: RunRecord) -> None:
        super().__init__(f"{run.outcome.name}: {run.message}")
        self.run = run


class Executor:
    """Executes tests, as many in parallel as the engine has capacity for; results do not depend on their number.

    Finished executions are read from the store, new ones added, and their bags written to the folder.

    Attributes:
        given_up: tests whose search continued without their outcome, in an earlier session.
        failed_executions: number of executions that ended in an error after all attempts.
    """

    def __init__(self, settings: DriveSettings, folder: Path, store: Store, engine: Engine, listener: Listener) -> None:
        self._settings, self._folder, self._store = settings, folder, store
        self._engine, self._listener = engine, listener
        self._stop = threading.Event()
        self._lock = threading.Lock()
        self._changed = threading.Condition()
        self._queues: dict[SimulatorName, deque[Callable[[], object]]] = {}
        self._unfinished = 0
        self._unlucky: dict[SimulatorName, int] = dict.fromkeys(settings.simulators, 0)
        self.given_up = store.given_up()
        self.failed_executions = 0

    def stop(self) -> None:
        """Start no further test."""
        self._stop.set()

    def execute_all(self, work: Mapping[SimulatorName, Sequence[Test]]) -> None:
        """Execute tests, given the simulator on which to drive each.

        Raises:
            Stopped: `stop` was called; finished executions are in the store.
            CampaignError: a simulator gave no outcome for `PATIENCE` tests in a row; the same call goes on there.
        """
        self.in_parallel({name: [partial(self.execute, test, name) for test in tests] for name, tests in work.items()})

    def in_parallel(self, work: Mapping[SimulatorName, Sequence[Callable[[], object]]]) -> None:
        """Run work on one thread per drive at a time; the first error stops all threads, even during a run.

        Calls that `follow` while it runs are taken when no other is left.
        """
        capacity = self._engine.capacity
        if capacity is None:
            queues, threads_each = {name: deque(units) for name, units in work.items()}, self._settings.workers
        else:
            # In turns, so that all simulators are busy until the end.
            mixed = deque(unit for turn in zip_longest(*work.values()) for unit in turn if unit is not None)
            queues, threads_each = dict.fromkeys(work, mixed), max(1, capacity)
        self._queues, self._unfinished = queues, sum(map(len, work.values()))
        different = list({id(queue): queue for queue in queues.values()}.values())
        with ThreadPoolExecutor(max(1, len(different) * threads_each)) as pool:
            try:
                futures = [pool.submit(self._work_off, queue) for queue in different for _ in range(threads_each)]
                for future in as_completed(futures):
                    future.result()
            except BaseException:
                self._stop.set()
                self._engine.stop()
                with self._changed:
                    self._changed.notify_all()
                raise

    def follow(self, simulator: SimulatorName, test: Test) -> None:
        """Let a test be executed on a simulator when a thread of `in_parallel`, which calls this, has nothing to do."""
        with self._changed:
            self._queues[simulator].append(partial(self.execute, test, simulator))
            self._unfinished += 1
            self._changed.notify_all()

    def _work_off(self, units: deque[Callable[[], object]]) -> None:
        """Run a queue's calls until none is left, and none is running that may let others follow."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: units or not self._unfinished or self._stop.is_set())
                if not units:
                    return
                unit = units.popleft()
            try:
                unit()
            finally:
                with self._changed:
                    self._unfinished -= 1
                    self._changed.notify_all()

    def _check_stop(self) -> None:
        if self._stop.is_set():
            raise Stopped

    def execute(self, test: Test, simulator: SimulatorName) -> Execution | Gate | None:
        """Return a test's execution on one simulator from the store, or drive it, repeating errors `retries` times.

        A test by which no network can be judged there is not driven: its gate is returned.
        """
        self._check_stop()
        stored = self._store.execution(test.test_id, simulator) or self._store.gate(test.test_id, simulator)
        if isinstance(stored, Execution) or (stored is not None and not stored.is_valid):
            self._listener.finished(test, simulator, stored, fresh=False)
            return stored
        outcome: Execution | Gate | None = None
        try:
            outcome = self._outcome(test, simulator)
        except NoOutcomeError as error:
            self._count_unlucky(test, simulator, error.run)
        else:
            with self._lock:
                self._unlucky[simulator] = 0
        self._listener.finished(test, simulator, outcome, fresh=True)
        return outcome

    def _outcome(self, test: Test, simulator: SimulatorName) -> Execution | Gate:
        """Drive a test; returns its gate if no network can be judged by it there."""
        gate = self.judge(test, simulator)
        if gate is not None and not gate.is_valid:
            return gate
        run = self._drive(test, simulator, self._settings.driver)
        excluded = exclusion_of(run)
        return self._keep(test, simulator, run) if excluded is None else self._keep_gate(test, simulator, excluded)

    def judge(self, test: Test, simulator: SimulatorName) -> Gate | None:
        """Decide, before a network drives a test, whether it can be judged by it there; None if the test has no gate.

        Each test is judged once on each simulator; see `ds_sim.gates`. NoOutcomeError if every attempt of the autopilot
        ended in an error; Stopped if the campaign is stopped before an attempt begins, or during one without a verdict.
        """
        if self._settings.gates == "none" or (test.conditions.is_default and self._settings.gates != "all"):
            return None
        stored = self._store.gate(test.test_id, simulator)
        if stored is not None:
            return stored
        try:
            spec_of(simulator).check(test.conditions)
        except NotApplicableError as error:
            return self._keep_gate(test, simulator, not_applicable(str(error)))
        run = self._drive(test, simulator, AUTOPILOT, probed=True)
        return self._keep_gate(test, simulator, exclusion_of(run) or gate_of(run))

    def _drive(self, test: Test, simulator: SimulatorName, driver: DriverName, *, probed: bool = False) -> RunRecord:
        """Drive until there is a verdict, or the simulator cannot realise the test; repeats errors `retries` times."""
        for attempt in range(self._settings.retries + 1):
            self._check_stop()
            request = DriveRequest(test.scenario, driver, simulator, probed=probed)
            with nullcontext() if probed else self._listener.driving(request) as watch:
                run = self._engine.drive(request, watch)
            if run.outcome.is_verdict or exclusion_of(run) is not None:
                return run
            self._check_stop()
            message = f"autopilot: {run.message}" if probed else run.message
            self._store.add_error(test.test_id, simulator, attempt, run.outcome, message)
        raise NoOutcomeError(run)

    def _count_unlucky(self, test: Test, simulator: SimulatorName, run: RunRecord) -> None:
        """Count a test without an outcome; raise CampaignError after `PATIENCE` of them in a row."""
        with self._lock:
            self.failed_executions += 1
            if test.sibling == simulator and test.test_id in self.given_up:
                return  # the search continued without it in an earlier session
            self._unlucky[simulator] += 1
            if self._unlucky[simulator] < PATIENCE:
                return
        raise CampaignError(
            f"{simulator} gave no outcome for {PATIENCE} tests in a row ({run.outcome.name}: {run.message}): see the "
            "folder logs, fix the cause, and run the same command again"
        )

    def _keep_gate(self, test: Test, simulator: SimulatorName, gate: Gate) -> Gate:
        self._store.add_gate(test.test_id, simulator, gate)
        return gate

    def _keep(self, test: Test, simulator: SimulatorName, run: RunRecord) -> Execution:
        """Write the bag, then the store."""
        bag = ""
        if self._settings.record != "none":
            bag = f"bags/{test.test_id}-on-{label_of(simulator)}"
            driver, record = self._settings.driver, self._settings.record
            about = {"test_id": test.test_id, "driver": str(driver)}
            namespace = self._settings.namespaces[simulator]
            from ds_bags.run_writer import write_bag
            from ds_driver.networks.network_driver import translation_of

            translate = None if record == "telemetry" else translation_of(driver, simulator)
            write_bag(self._folder / bag, namespace, simulator, run, about, record, translate=translate)
        execution = execution_of(test.test_id, simulator, run, bag)
        self._store.add_execution(execution)
        return execution


def execution_of(test_id: str, simulator: SimulatorName, run: RunRecord, bag: str = "") -> Execution:
    """Convert a run to the form in which the store keeps it."""
    trajectory = _trajectory_of(run)
    return Execution(
        test_id=test_id,
        simulator=simulator,
        outcome=run.outcome,
        message=run.message,
        fitness=run.fitness,
        max_lateral_position=run.max_lateral_position,
        steps=run.steps,
        simulated_seconds=run.simulated_seconds,
        trajectory_sha256=rows.trajectory_sha256(trajectory),
        drive=DriveArrays(trajectory, np.array([c.steering for c in run.commands], dtype=np.float64)),
        bag=bag,
    )


def trajectory_sha256(run: RunRecord) -> str:
    """Compute the digest of a run; see `ds_orchestrator.store.rows.trajectory_sha256`."""
    return rows.trajectory_sha256(_trajectory_of(run))


def _trajectory_of(run: RunRecord) -> NDArray[np.float64]:
    """Return x, y, yaw, speed and lateral position of every step, (steps + 1, 5)."""
    values = [
        (o.vehicle.x, o.vehicle.y, o.vehicle.yaw, o.vehicle.speed, o.lane.lateral_position) for o in run.observations
    ]
    return np.array(values, dtype=np.float64).reshape(-1, 5)
