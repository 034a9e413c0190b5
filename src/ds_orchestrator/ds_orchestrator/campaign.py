"""The method, end to end: search on every sibling, migration to the others, all tests on the twin (paper 3, figure 1).

What is done stands in the store, and a search is replayed from it: its random choices depend on the seed and on the
fitness of earlier tests alone. So a stopped campaign goes on where it was, and no finished test runs again.
"""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Protocol

import numpy as np

from ds_orchestrator.bags import write_bag
from ds_orchestrator.config import CampaignConfig
from ds_orchestrator.search import DeepHyperion
from ds_orchestrator.store import Execution, Store, Test
from ds_road import Road
from ds_sim.registry import label_of
from ds_sim.session import RunRecord

PATIENCE = 5
"""Tests in a row without an outcome, each tried again as configured, after which a simulator counts as broken; chosen:
two or three can be bad luck."""


class Executor(Protocol):
    """Drives a road on a simulator, wherever that runs."""

    def execute(self, simulator: str, road: Road, seed: int) -> RunRecord:
        """Drive to an outcome; errors are outcomes too. May be called from one thread per simulator."""
        ...

    def stop(self) -> None:
        """Let every run under way end now, as CANCELLED."""
        ...


class Stopped(Exception):
    """The campaign was asked to stop."""


class CampaignError(RuntimeError):
    """A campaign that cannot go on as things are."""


class Watcher(Protocol):
    """Is told what happens; called from several threads."""

    def stage(self, name: str) -> None:
        """A stage begins."""
        ...

    def finished(self, test: Test, simulator: str, execution: Execution | None, fresh: bool) -> None:
        """An execution is done; None if it ended in an error for good; not fresh if it stood in the store."""
        ...


class Campaign:
    """Runs a campaign's stages; safe to stop at any moment.

    Args:
        config: what to do.
        folder: of the campaign, for bags.
        store: what was done before, and where the rest goes.
        executor: drives.
        watcher: is told what happens.
        namespaces: of the simulators, for the bags' topics.
    """

    def __init__(
        self,
        config: CampaignConfig,
        folder: Path,
        store: Store,
        executor: Executor,
        watcher: Watcher,
        namespaces: dict[str, str],
    ) -> None:
        self._config = config
        self._folder = folder
        self._store = store
        self._executor = executor
        self._watcher = watcher
        self._namespaces = namespaces
        self._stop = threading.Event()
        self._unlucky: dict[str, list[str]] = {name: [] for name in config.simulators}
        self._given_up = store.given_up()
        self.failed_executions = 0

    @staticmethod
    def executions_in_all(config: CampaignConfig) -> int:
        """How many executions a campaign consists of."""
        tests = config.search.runs * config.search.settings().iterations
        tests += config.search.runs * config.search.population
        return tests * len(config.siblings) * len(config.simulators)

    def stop(self) -> None:
        """Let no further test begin."""
        self._stop.set()

    def run(self) -> None:
        """Run every stage.

        Raises:
            Stopped: `stop` was called; what was finished stands in the store.
            CampaignError: a simulator gave no outcome for `PATIENCE` tests in a row; the same command goes on there.
        """
        self._watcher.stage("search")
        siblings = self._config.siblings
        self._in_parallel(siblings, self._search)
        self._watcher.stage("migration and twin" if self._config.twin else "migration")
        tests = self._store.tests()
        self._in_parallel(self._config.simulators, lambda simulator: self._migrate(simulator, tests))

    def _in_parallel(self, simulators: Sequence[str], work: Callable[[str], None]) -> None:
        """One thread per simulator; the first error stops the others, also in the midst of a run."""
        with ThreadPoolExecutor(len(simulators)) as pool:
            futures = [pool.submit(work, simulator) for simulator in simulators]
            try:
                for future in as_completed(futures):
                    future.result()
            except BaseException:
                self._stop.set()
                self._executor.stop()
                raise

    def _search(self, sibling: str) -> None:
        """Every run of the search on one sibling, with what the store knows already.

        A search that went on without a test's outcome does so again, even if the test has one by now: the roads that
        followed are in the store.
        """
        for run in range(self._config.search.runs):
            rng = np.random.default_rng(_seed(self._config.seed, "search", sibling, run))
            search = DeepHyperion(self._config.search.settings(), rng)
            for number in range(search.budget):
                test_id = f"{label_of(sibling)}-{run}-{number:04d}"
                test = Test(
                    test_id=test_id,
                    sibling=sibling,
                    run=run,
                    number=number,
                    road=search.ask(),
                    seed=_seed(self._config.seed, "test", test_id),
                )
                self._store.add_test(test)
                execution = self._execute(test, sibling)
                if execution is None:
                    self._store.give_up(test_id)
                if execution is None or test_id in self._given_up:
                    search.tell(None)
                else:
                    search.tell(execution.fitness, failed=execution.outcome.is_failure)

    def _migrate(self, simulator: str, tests: Sequence[Test]) -> None:
        """Every test that another sibling's search made (paper 3.4); all of them on the twin (paper 3.6)."""
        for test in tests:
            if test.sibling != simulator:
                self._execute(test, simulator)

    def _execute(self, test: Test, simulator: str) -> Execution | None:
        """One test on one simulator: from the store, or driven, with a bounded number of attempts at errors."""
        known = self._store.execution(test.test_id, simulator)
        if known is not None:
            self._watcher.finished(test, simulator, known, fresh=False)
            return known
        for attempt in range(self._config.retries + 1):
            if self._stop.is_set():
                raise Stopped
            run = self._executor.execute(simulator, test.road, test.seed)
            if run.outcome.is_error and self._stop.is_set():
                raise Stopped
            if run.outcome.is_verdict:
                execution = self._keep(test, simulator, run)
                self._unlucky[simulator].clear()
                self._watcher.finished(test, simulator, execution, fresh=True)
                return execution
            self._store.add_error(test.test_id, simulator, attempt, run.outcome, run.message)
        self.failed_executions += 1
        self._count_unlucky(test, simulator, run)
        self._watcher.finished(test, simulator, None, fresh=True)
        return None

    def _count_unlucky(self, test: Test, simulator: str, run: RunRecord) -> None:
        """Stop where it is no longer this test's bad luck, and leave the tests as if they had never been tried."""
        if test.sibling == simulator and test.test_id in self._given_up:
            return  # the search has gone on without it in an earlier session
        unlucky = self._unlucky[simulator]
        unlucky.append(test.test_id)
        if len(unlucky) < PATIENCE:
            return
        if test.sibling == simulator:
            self._store.take_back([t for t in unlucky if t.rpartition("-")[0] == test.test_id.rpartition("-")[0]])
        raise CampaignError(
            f"{simulator} gave no outcome for {PATIENCE} tests in a row ({run.outcome.name}: {run.message}): see the "
            "folder logs, mend it, and give the same command again"
        )

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
        trajectory=np.array(
            [
                (o.vehicle.x, o.vehicle.y, o.vehicle.yaw, o.vehicle.speed, o.lane.lateral_position)
                for o in run.observations
            ],
            dtype=np.float64,
        ).reshape(-1, 5),
        bag=bag,
    )


def trajectory_sha256(run: RunRecord) -> str:
    """SHA-256 over the little-endian float64 bytes of x, y, yaw and speed of every step, the one at rest included."""
    rows = [(o.vehicle.x, o.vehicle.y, o.vehicle.yaw, o.vehicle.speed) for o in run.observations]
    return hashlib.sha256(np.array(rows, dtype="<f8").tobytes()).hexdigest()


def _seed(*parts: int | str) -> int:
    """A seed that depends on all its parts and on nothing else; 32 bits, so that every interface carries it."""
    text = "/".join(map(str, parts)).encode()
    return int.from_bytes(hashlib.sha256(text).digest()[:4], "little")
