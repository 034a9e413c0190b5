"""The method, end to end: search on every sibling, migration to the others, all tests on the twin (paper 3, figure 1).

What is done stands in the store, and a search is replayed from it: its random choices depend on the seed and on the
fitness of earlier tests alone. So a stopped campaign goes on where it was, and no finished test runs again.
"""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ds_bags.run_writer import write_bag
from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.maps.campaign_maps import cells_of, elites_of
from ds_orchestrator.search.algorithms import SEARCHES
from ds_orchestrator.search.features import cell_of
from ds_orchestrator.store import rows
from ds_orchestrator.store.store import Execution, Store, Test
from ds_road import Road
from ds_sim.registry import label_of
from ds_sim.session import RunRecord

PATIENCE = 5
"""Tests in a row without an outcome, each tried again as configured, after which a simulator counts as broken; chosen:
two or three can be bad luck."""


class Executor(Protocol):
    """Drives a road on a simulator, wherever that runs."""

    def execute(self, simulator: str, road: Road, seed: int) -> RunRecord:
        """Drive to an outcome; errors are outcomes too. Called from one thread per simulator and worker."""
        ...

    def stop(self) -> None:
        """Let every run under way end now, as CANCELLED."""
        ...


class Stopped(Exception):
    """The campaign was asked to stop."""


class CampaignError(RuntimeError):
    """A campaign that cannot go on as things are."""


class Listener(Protocol):
    """Is told what happens; called from several threads."""

    def stage(self, name: str) -> None:
        """A stage begins."""
        ...

    def expect(self, stages: Sequence[Mapping[str, int]]) -> None:
        """How many executions there are on each simulator, in the search and after it, done ones included."""
        ...

    def finished(self, test: Test, simulator: str, execution: Execution | None, fresh: bool) -> None:
        """An execution is done; None if it ended in an error for good; not fresh if it stood in the store."""
        ...


class Campaign:
    """Runs a campaign's stages; safe to stop at any moment.

    Runs of the search on one sibling do not know of each other, nor do the executions of the later stages, so that
    `config.workers` of them go on at the same time on every simulator, and the results do not depend on their number.

    Args:
        config: what to do.
        folder: of the campaign, for bags.
        store: what was done before, and where the rest goes.
        executor: drives.
        listener: is told what happens.
        namespaces: of the simulators, for the bags' topics.
    """

    def __init__(
        self,
        config: CampaignConfig,
        folder: Path,
        store: Store,
        executor: Executor,
        listener: Listener,
        namespaces: dict[str, str],
    ) -> None:
        self._config = config
        self._folder = folder
        self._store = store
        self._executor = executor
        self._listener = listener
        self._namespaces = namespaces
        self._stop = threading.Event()
        self._lock = threading.Lock()
        self._unlucky: dict[str, int] = dict.fromkeys(config.simulators, 0)
        self._given_up = store.given_up()
        self.failed_executions = 0

    def stop(self) -> None:
        """Let no further test begin."""
        self._stop.set()

    def run(self) -> None:
        """Run every stage that drives.

        Raises:
            Stopped: `stop` was called; what was finished stands in the store.
            CampaignError: a simulator gave no outcome for `PATIENCE` tests in a row; the same command goes on there.
        """
        config = self._config
        own = config.search.runs * config.settings.budget
        search = dict.fromkeys(config.siblings, own)
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
        foreign = {name: [test for test in chosen if test.sibling != name] for name in config.simulators}
        self._listener.expect([search, {name: len(theirs) for name, theirs in foreign.items()}])
        self._listener.stage("migration and twin" if config.twin else "migration")
        # Every test on the siblings that did not make it (paper 3.4), all of them on the twin (paper 3.6).
        self._in_parallel(
            {name: [partial(self._execute, test, name) for test in theirs] for name, theirs in foreign.items()}
        )

    def _migrated(self, tests: Sequence[Test]) -> Sequence[Test]:
        """The tests that leave the sibling on which they were found."""
        if not self._config.elites_only:
            return tests
        executions = self._store.executions()
        plan = self._config.map_plan()
        cells = cells_of(tests, executions, features=plan.features, maxitwo_compatible=plan.maxitwo_compatible)
        elites = elites_of(tests, executions, cells, ignored=self._store.given_up())
        return [test for test in tests if test.test_id in elites]

    def _in_parallel(self, work: Mapping[str, Sequence[Callable[[], object]]]) -> None:
        """As many threads per simulator as there are workers; the first error stops the others, amid a run too."""
        queues: list[SimpleQueue[Callable[[], object]]] = []
        for units in work.values():
            queues.append(SimpleQueue())
            for unit in units:
                queues[-1].put(unit)
        workers = self._config.workers
        with ThreadPoolExecutor(len(queues) * workers) as pool:
            futures = [pool.submit(self._work_off, queue) for queue in queues for _ in range(workers)]
            try:
                for future in as_completed(futures):
                    future.result()
            except BaseException:
                self._stop.set()
                self._executor.stop()
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
        """One run of the search on one sibling, with what the store knows already.

        A search that went on without a test's outcome does so again, even if the test has one by now: the roads that
        followed are in the store.
        """
        config = self._config
        seed = _seed(config.seed, "search", sibling, run)
        self._store.add_search(sibling, run, config.search.method, seed)
        search = SEARCHES[config.search.method](config.settings, np.random.default_rng(seed))
        for number in range(search.budget):
            test_id = f"{label_of(sibling)}-{run}-{number:04d}"
            road = search.ask()
            test_seed = _seed(config.seed, "test", test_id)
            test = Test(test_id=test_id, sibling=sibling, run=run, number=number, road=road, seed=test_seed)
            self._store.add_test(test)
            execution = self._execute(test, sibling)
            if execution is None:
                self._store.give_up(test_id)
            if execution is None or test_id in self._given_up:
                search.tell(None)
            else:
                cell = cell_of(road, execution, features=config.features, maxitwo_compatible=config.maxitwo_compatible)
                search.tell(execution.fitness, failed=execution.outcome.is_failure, cell=cell)

    def _execute(self, test: Test, simulator: str) -> Execution | None:
        """One test on one simulator: from the store, or driven, with a bounded number of attempts at errors."""
        known = self._store.execution(test.test_id, simulator)
        if known is not None:
            self._listener.finished(test, simulator, known, fresh=False)
            return known
        for attempt in range(self._config.retries + 1):
            if self._stop.is_set():
                raise Stopped
            run = self._executor.execute(simulator, test.road, test.seed)
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

    def _count_unlucky(self, test: Test, simulator: str, run: RunRecord) -> None:
        """Stop where it is no longer this test's bad luck."""
        with self._lock:
            self.failed_executions += 1
            if test.sibling == simulator and test.test_id in self._given_up:
                return  # the search has gone on without it in an earlier session
            self._unlucky[simulator] += 1
            if self._unlucky[simulator] < PATIENCE:
                return
        raise CampaignError(
            f"{simulator} gave no outcome for {PATIENCE} tests in a row ({run.outcome.name}: {run.message}): see the "
            "folder logs, mend it, and give the same command again"
        )

    def _take_back(self, sibling: str) -> None:
        """Leave the tests with which the runs of a search ended without any outcome as if never tried."""
        done = {e.test_id for e in self._store.executions() if e.simulator == sibling}
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
            write_bag(self._folder / bag, namespace, simulator, run, about, self._config.record)
        execution = execution_of(test.test_id, simulator, run, bag)
        self._store.add_execution(execution)
        return execution


def execution_of(test_id: str, simulator: str, run: RunRecord, bag: str = "") -> Execution:
    """A run as the store keeps it."""
    return Execution(
        test_id=test_id,
        simulator=simulator,
        outcome=run.outcome,
        message=run.message,
        fitness=run.fitness,
        max_lateral_position=run.max_lateral_position,
        steps=run.steps,
        simulated_seconds=run.simulated_seconds,
        trajectory_sha256=trajectory_sha256(run),
        trajectory=_trajectory_of(run),
        bag=bag,
        steering=np.array([command.steering for command in run.commands], dtype=np.float64),
    )


def trajectory_sha256(run: RunRecord) -> str:
    """Digest of a run; see `ds_orchestrator.store.rows.trajectory_sha256`."""
    return rows.trajectory_sha256(_trajectory_of(run))


def _trajectory_of(run: RunRecord) -> NDArray[np.float64]:
    """Return x, y, yaw, speed and lateral position of every step, (steps + 1, 5)."""
    values = [
        (o.vehicle.x, o.vehicle.y, o.vehicle.yaw, o.vehicle.speed, o.lane.lateral_position) for o in run.observations
    ]
    return np.array(values, dtype=np.float64).reshape(-1, 5)


def _seed(*parts: int | str) -> int:
    """A seed that depends on all its parts and on nothing else; 32 bits, so that every interface carries it."""
    text = "/".join(map(str, parts)).encode()
    return int.from_bytes(hashlib.sha256(text).digest()[:4], "little")
