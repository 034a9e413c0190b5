"""Runs the method: search on every sibling, migration to the others, all tests on the twin (paper 3, figure 1).

Finished executions are in the store, and a search is replayed from them: its random choices depend only on the seed
and on the fitness of earlier tests. A stopped campaign therefore resumes without repeating a finished test.
"""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import partial
from itertools import zip_longest
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ds_bags.run_writer import write_bag
from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.gatekeeper import GateDriver, GateError, Gatekeeper
from ds_orchestrator.maps.campaign_maps import cells_of, elites_of
from ds_orchestrator.search.algorithms import SEARCHES
from ds_orchestrator.search.features import cell_of
from ds_orchestrator.search.objectives import OBJECTIVES
from ds_orchestrator.store import rows
from ds_orchestrator.store.model import Execution, Test
from ds_orchestrator.store.store import Store
from ds_road import Road
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.gates.gate import Gate
from ds_sim.registry import label_of
from ds_sim.session import RunRecord
from ds_sim.simulator import Reason

PATIENCE = 5
"""A simulator counts as broken after this many consecutive tests without an outcome, retries included; chosen: two or
three may be coincidence."""


class Executor(Protocol):
    """Drives roads on simulators, in this process or in others."""

    @property
    def capacity(self) -> int | None:
        """Drives at a time, on whatever simulators; None where each simulator takes `config.workers` at a time."""
        ...

    def execute(self, simulator: str, road: Road, seed: int, conditions: Conditions = DEFAULT) -> RunRecord:
        """Drive to an outcome; errors are outcomes too. Called from one thread per simulator and worker."""
        ...

    def stop(self) -> None:
        """Cancel all active runs immediately."""
        ...


class Stopped(Exception):
    """Campaign that was stopped by request."""


class CampaignError(RuntimeError):
    """Campaign that cannot continue because a simulator is broken."""


class Listener(Protocol):
    """Callbacks on a campaign's progress; called from several threads."""

    def stage(self, name: str) -> None:
        """Handle the start of a stage."""
        ...

    def expect(self, stages: Sequence[Mapping[str, int]]) -> None:
        """Handle the expected executions: per stage, simulator -> their number, finished ones included."""
        ...

    def finished(self, test: Test, simulator: str, execution: Execution | Gate | None, fresh: bool) -> None:
        """Handle the end of an execution.

        Args:
            test: test that was driven.
            simulator: name of the simulator.
            execution: outcome; why the test is excluded there; or None if every attempt ended in an error.
            fresh: False if the execution was read from the store.
        """
        ...


class Campaign:
    """Runs a campaign's stages; safe to stop at any moment.

    Search runs on one sibling are independent of each other, and so are the executions of the later stages. As many of
    them run in parallel as the executor has capacity for; results do not depend on their number.

    Args:
        config: configuration of the campaign.
        folder: campaign folder, for bags.
        store: store of the campaign; finished executions are read from it, new ones added.
        executor: drives the roads.
        listener: receives progress.
        namespaces: simulator name -> ROS namespace, for the bags' topics.
        gate_driver: drives the autopilot for the gates; None for a campaign without gates.
    """

    def __init__(
        self,
        config: CampaignConfig,
        folder: Path,
        store: Store,
        executor: Executor,
        listener: Listener,
        namespaces: dict[str, str],
        gate_driver: GateDriver | None = None,
    ) -> None:
        self._config = config
        self._folder = folder
        self._store = store
        self._executor = executor
        self._listener = listener
        self._namespaces = namespaces
        self._objective = OBJECTIVES[config.search.objective]
        self._gatekeeper = Gatekeeper(config, store, gate_driver)
        self._stop = threading.Event()
        self._lock = threading.Lock()
        self._unlucky: dict[str, int] = dict.fromkeys(config.simulators, 0)
        self._given_up = store.given_up()
        self.failed_executions = 0

    def stop(self) -> None:
        """Start no further test."""
        self._stop.set()

    def run(self) -> None:
        """Run every stage that drives.

        Raises:
            Stopped: `stop` was called; finished executions are in the store.
            CampaignError: a simulator gave no outcome for `PATIENCE` tests in a row; the same command resumes there.
        """
        config = self._config
        own = config.search.runs * config.settings.budget
        search = dict.fromkeys(config.siblings, own * len(self._searched_on(config.siblings[0])))
        everything = own * len(config.siblings)
        self._listener.expect([search, {name: everything - search.get(name, 0) for name in config.simulators}])
        self._listener.stage("search")
        searches = {
            sibling: [partial(self._search, sibling, run) for run in range(config.search.runs)]
            for sibling in config.siblings
        }
        try:
            self._in_parallel(searches)
        except CampaignError:
            for sibling in config.siblings:
                self._take_back(sibling)
            raise
        tests = self._store.tests()
        chosen = self._migrated(tests)
        foreign = {
            name: [test for test in chosen if name not in self._searched_on(test.sibling)] for name in config.simulators
        }
        self._listener.expect([search, {name: len(migrated) for name, migrated in foreign.items()}])
        self._listener.stage("migration and twin" if config.twin else "migration")
        # Every test runs on the siblings that did not generate it (paper 3.4), all of them on the twin (paper 3.6).
        self._in_parallel(
            {name: [partial(self._execute, test, name) for test in migrated] for name, migrated in foreign.items()}
        )

    def drive(self, work: Mapping[str, Sequence[Test]]) -> None:
        """Drive given tests instead of searching for any.

        Args:
            work: simulator -> tests to drive there.

        Raises:
            Stopped: `stop` was called; finished executions are in the store.
            CampaignError: as for `run`.
        """
        for test in {test.test_id: test for tests in work.values() for test in tests}.values():
            self._store.add_test(test)
        own = {name: sum(test.sibling == name for test in tests) for name, tests in work.items()}
        self._listener.expect([own, {name: len(tests) - own[name] for name, tests in work.items()}])
        self._listener.stage("given tests")
        self._in_parallel(
            {name: [partial(self._execute, test, name) for test in tests] for name, tests in work.items()}
        )

    def _migrated(self, tests: Sequence[Test]) -> Sequence[Test]:
        """Select the tests that migrate from the sibling whose search generated them."""
        if not self._config.elites_only:
            return tests
        executions = self._store.executions()
        plan = self._config.map_plan()
        cells = cells_of(
            tests,
            executions,
            features=plan.features,
            maxitwo_compatible=plan.maxitwo_compatible,
            gates=self._store.gates(),
        )
        elites = elites_of(tests, executions, cells, ignored=self._store.given_up())
        return [test for test in tests if test.test_id in elites]

    def _in_parallel(self, work: Mapping[str, Sequence[Callable[[], object]]]) -> None:
        """Run work on one thread per drive at a time; the first error stops all threads, even during a run."""
        capacity = self._executor.capacity
        if capacity is None:
            queues, threads_each = [_queue(units) for units in work.values()], self._config.workers
        else:
            # In turns, so that all simulators are busy until the end.
            mixed = [unit for turn in zip_longest(*work.values()) for unit in turn if unit is not None]
            queues, threads_each = [_queue(mixed)], max(1, min(capacity, len(mixed)))
        with ThreadPoolExecutor(len(queues) * threads_each) as pool:
            try:
                futures = [pool.submit(self._work_off, queue) for queue in queues for _ in range(threads_each)]
                for future in as_completed(futures):
                    future.result()
            except BaseException:
                self._stop.set()
                self._executor.stop()
                self._gatekeeper.stop()
                raise

    @staticmethod
    def _work_off(units: SimpleQueue[Callable[[], object]]) -> None:
        while True:
            try:
                unit = units.get_nowait()
            except Empty:
                return
            unit()

    def _search(self, sibling: str, run: int) -> None:
        """Run or replay one search run on one sibling, taking known outcomes from the store.

        A search that continued without a test's outcome ignores it on replay, even if the test has one by now: the
        roads that followed are in the store.
        """
        config = self._config
        seed = _seed(config.seed, "search", sibling, run)
        self._store.add_search(sibling, run, config.search.method, seed)
        search = SEARCHES[config.search.method](config.settings, np.random.default_rng(seed))
        for number in range(search.budget):
            test_id = f"{label_of(sibling)}-{run}-{number:04d}"
            candidate = search.ask_test()
            test_seed = _seed(config.seed, "test", test_id)
            test = Test(
                test_id=test_id,
                sibling=sibling,
                run=run,
                number=number,
                road=candidate.road,
                seed=test_seed,
                conditions=candidate.conditions,
            )
            self._store.add_test(test)
            executions = {name: self._execute(test, name) for name in self._searched_on(sibling)}
            without_outcome = any(execution is None for execution in executions.values())
            if without_outcome:
                self._store.give_up(test_id)
            driven = {name: e for name, e in executions.items() if isinstance(e, Execution)}
            if sibling not in driven or without_outcome or test_id in self._given_up:
                search.tell(None)
                continue
            gate = self._store.gate(test_id, sibling)
            cell = cell_of(
                test.road,
                driven[sibling],
                features=config.features,
                maxitwo_compatible=config.maxitwo_compatible,
                conditions=test.conditions,
                line_contrast=None if gate is None else gate.line_contrast,
            )
            score = self._objective.score(driven)
            search.tell(score.fitness, failed=score.found, cell=cell)

    def _searched_on(self, sibling: str) -> list[str]:
        """Simulators on which the search of a sibling drives its tests, that sibling first."""
        others = [name for name in self._config.siblings if name != sibling] if self._objective.everywhere else []
        return [sibling, *others]

    def _check_stop(self) -> None:
        if self._stop.is_set():
            raise Stopped

    def _execute(self, test: Test, simulator: str) -> Execution | Gate | None:
        """Return a test's execution on one simulator from the store, or drive it, repeating errors `retries` times.

        A test by which no network can be judged there is not driven: its gate is returned.
        """
        self._check_stop()
        known = self._store.execution(test.test_id, simulator) or self._store.gate(test.test_id, simulator)
        if isinstance(known, Execution) or (known is not None and not known.is_valid):
            self._listener.finished(test, simulator, known, fresh=False)
            return known
        try:
            gate = self._gatekeeper.judge(test, simulator, check_stop=self._check_stop)
        except GateError as error:
            self._count_unlucky(test, simulator, error.run)
            self._listener.finished(test, simulator, None, fresh=True)
            return None
        if gate is not None and not gate.is_valid:
            return self._excluded(test, simulator, gate)
        for attempt in range(self._config.retries + 1):
            self._check_stop()
            run = self._executor.execute(simulator, test.road, test.seed, test.conditions)
            if run.reason is Reason.NOT_APPLICABLE:
                return self._excluded(test, simulator, self._gatekeeper.refused(test, simulator, run.message))
            if run.outcome.is_error and self._stop.is_set():
                raise Stopped
            if run.outcome.is_verdict:
                execution = self._keep(test, simulator, run)
                with self._lock:
                    self._unlucky[simulator] = 0
                self._listener.finished(test, simulator, execution, fresh=True)
                return execution
            self._store.add_error(test.test_id, simulator, attempt, run.outcome, run.message)
        self._count_unlucky(test, simulator, run)
        self._listener.finished(test, simulator, None, fresh=True)
        return None

    def _excluded(self, test: Test, simulator: str, gate: Gate) -> Gate:
        with self._lock:
            self._unlucky[simulator] = 0
        self._listener.finished(test, simulator, gate, fresh=True)
        return gate

    def _count_unlucky(self, test: Test, simulator: str, run: RunRecord) -> None:
        """Count a test without an outcome; raise CampaignError after `PATIENCE` of them in a row."""
        with self._lock:
            self.failed_executions += 1
            if test.sibling == simulator and test.test_id in self._given_up:
                return  # the search continued without it in an earlier session
            self._unlucky[simulator] += 1
            if self._unlucky[simulator] < PATIENCE:
                return
        raise CampaignError(
            f"{simulator} gave no outcome for {PATIENCE} tests in a row ({run.outcome.name}: {run.message}): see the "
            "folder logs, fix the cause, and run the same command again"
        )

    def _take_back(self, sibling: str) -> None:
        """Forget the trailing tests of each search run that have no outcome, so that they are tried again."""
        done = {e.test_id for e in self._store.executions() if e.simulator == sibling}
        done |= {i for (i, name), gate in self._store.gates().items() if name == sibling and not gate.is_valid}
        runs: dict[int, list[str]] = {}
        for test in self._store.tests():
            if test.sibling == sibling:
                last = runs.setdefault(test.run, [])
                if test.test_id in done or test.test_id in self._given_up:
                    last.clear()
                else:
                    last.append(test.test_id)
        for tests in runs.values():
            self._store.take_back(tests)

    def _keep(self, test: Test, simulator: str, run: RunRecord) -> Execution:
        """Write the bag, then the store."""
        bag = ""
        if self._config.record != "none":
            bag = f"bags/{test.test_id}-on-{label_of(simulator)}"
            about = {"test_id": test.test_id, "driver": self._config.driver}
            namespace = self._namespaces[simulator]
            from ds_driver.sim2real.stage import translation_of

            translate = None if self._config.record == "telemetry" else translation_of(self._config.driver, simulator)
            write_bag(self._folder / bag, namespace, simulator, run, about, self._config.record, translate=translate)
        execution = execution_of(test.test_id, simulator, run, bag)
        self._store.add_execution(execution)
        return execution


def _queue(units: Sequence[Callable[[], object]]) -> SimpleQueue[Callable[[], object]]:
    queue: SimpleQueue[Callable[[], object]] = SimpleQueue()
    for unit in units:
        queue.put(unit)
    return queue


def execution_of(test_id: str, simulator: str, run: RunRecord, bag: str = "") -> Execution:
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
        trajectory=trajectory,
        bag=bag,
        steering=np.array([command.steering for command in run.commands], dtype=np.float64),
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


def _seed(*parts: int | str) -> int:
    """Derive a seed from its parts; 32 bits, so that every interface can carry it."""
    text = "/".join(map(str, parts)).encode()
    return int.from_bytes(hashlib.sha256(text).digest()[:4], "little")
