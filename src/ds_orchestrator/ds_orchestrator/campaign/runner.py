# SPDX-License-Identifier: Apache-2.0
"""Runs the method: search on every sibling, migration to the others, all tests on the twin (paper 3, figure 1).

Finished executions are in the store, and a search is replayed from them: its random choices depend only on the seed
and on the fitness of earlier tests. A stopped campaign therefore resumes without repeating a finished test.
"""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np

from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.engine import Engine
from ds_orchestrator.campaign.executor import CampaignError, Executor, Listener
from ds_orchestrator.campaign.folder import read_campaign
from ds_orchestrator.maps.campaign_maps import cell_of_test, elites_of
from ds_orchestrator.search.algorithms import search_of
from ds_orchestrator.store.model import Execution, Origin, Test
from ds_orchestrator.store.store import Store
from ds_sim.registry import SimulatorName, label_of


class Campaign:
    """Runs a campaign's stages; safe to stop at any moment.

    Search runs on one sibling are independent of each other, and so are the executions of the later stages. Finished
    executions are read from the store, new ones added, and their bags written to the folder.
    """

    def __init__(self, config: CampaignConfig, folder: Path, store: Store, engine: Engine, listener: Listener) -> None:
        self._config, self._store, self._listener = config, store, listener
        self._executor = Executor(config.drive_settings(), folder, store, engine, listener)
        self._lock, self._stages = threading.Lock(), ExitStack()
        self._followed = set[str]()
        runs = range(config.search.runs)
        self._searches = {name: [self._search(name, run) for run in runs] for name in config.siblings}

    @property
    def failed_executions(self) -> int:
        """Number of executions that ended in an error after all attempts."""
        return self._executor.failed_executions

    def stop(self) -> None:
        """Start no further test."""
        self._executor.stop()

    def run(self, tests: int | None = None) -> None:
        """Run every stage that drives; called again, it goes on where it was.

        Args:
            tests: further tests of each search, driven on every simulator; the rest if None. Where only elites migrate,
                which of them do depends on all tests.

        Raises:
            Stopped: `stop` was called; finished executions are in the store.
            CampaignError: a simulator gave no outcome for `PATIENCE` tests in a row; the same command resumes there.
        """
        config = self._config
        own = config.search.runs * config.settings.budget
        search = dict.fromkeys(config.siblings, own)
        self._listener.expect([search, {name: config.tests - search.get(name, 0) for name in config.simulators}])
        searches = {
            name: [partial(self._advance, one, tests) for one in self._searches.get(name, ())]
            for name in config.simulators
        }
        self._searching = sum(map(len, searches.values()))
        with self._stages:
            self._stages.enter_context(self._stage("search"))
            try:
                self._executor.in_parallel(searches)
            except CampaignError:
                for sibling in config.siblings if self._searching else ():
                    self._take_back(sibling)
                raise
            migrated = self._migrated()
            foreign = {name: [test for test in migrated if name != test.sibling] for name in config.simulators}
            if tests is None:
                self._listener.expect([search, {name: len(of) for name, of in foreign.items()}])
            left = {name: [test for test in of if test.test_id not in self._followed] for name, of in foreign.items()}
            self._executor.execute_all(left)
            self._followed.update(test.test_id for test in migrated)

    @contextmanager
    def _stage(self, name: str) -> Iterator[None]:
        """Announce a stage, and add its wall-clock time to that of earlier sessions; no result depends on it."""
        self._listener.stage(name)
        began = time.monotonic()
        try:
            yield
        finally:
            self._store.add_seconds(name, time.monotonic() - began)

    def _migrated(self) -> Sequence[Test]:
        """Select the tests that migrate from the sibling whose search generated them."""
        if not self._config.elites_only:
            return self._store.tests()
        data = read_campaign(self._store)
        elites = elites_of(data.tests, data.executions, data.cells, ignored=data.given_up)
        return [test for test in data.tests if test.test_id in elites]

    def _advance(self, search: Iterator[None], tests: int | None) -> None:
        """Go on with a search for so many tests, or to its end; the last one that stops begins the next stage."""
        for _ in islice(search, tests):
            pass
        with self._lock:
            self._searching -= 1
            if not self._searching:
                self._stages.close()
                self._stages.enter_context(self._stage("migration and twin" if self._config.twin else "migration"))

    def _search(self, sibling: SimulatorName, run: int) -> Iterator[None]:
        """Run or replay one search run on one sibling, test by test, taking known outcomes from the store.

        A search that continued without a test's outcome ignores it on replay, even if the test has one by now: the
        roads that followed are in the store.
        """
        config = self._config
        seed = _seed(config.seed, "search", sibling, run)
        self._store.add_search(sibling, run, config.search.method, seed)
        search = search_of(config.search.method)(config.settings, np.random.default_rng(seed))
        for number in range(search.budget):
            test_id = f"{label_of(sibling)}-{run}-{number:04d}"
            scenario = search.ask_test(_seed(config.seed, "test", test_id))
            test = Test(test_id, scenario, Origin(sibling, run, number))
            self._store.add_test(test)
            execution = self._executor.execute(test, sibling)
            if execution is None:
                self._store.give_up(test_id)
            elif not config.elites_only:
                self._migrate(test)
            if not isinstance(execution, Execution) or test_id in self._executor.given_up:
                search.tell(None)
                yield
                continue
            gate, as_maxitwo = self._store.gate(test_id, sibling), config.maxitwo_compatible
            cell = cell_of_test(test, execution, gate, config.features, maxitwo_compatible=as_maxitwo)
            search.tell(execution.fitness, failed=execution.outcome.is_failure, cell=cell)
            yield

    def _migrate(self, test: Test) -> None:
        """Let a finished test be driven on every other simulator, whenever no search needs the engine.

        Every test runs on the siblings that did not generate it (paper 3.4), all of them on the twin (paper 3.6). No
        result depends on the order.
        """
        self._followed.add(test.test_id)
        for name in self._config.simulators:
            if name != test.sibling:
                self._executor.follow(name, test)

    def _take_back(self, sibling: SimulatorName) -> None:
        """Forget the trailing tests of each search run that have no outcome, so that they are tried again."""
        done = {e.test_id for e in self._store.executions() if e.simulator == sibling}
        done |= {i for (i, name), gate in self._store.gates().items() if name == sibling and not gate.is_valid}
        runs: dict[int, list[str]] = {}
        for test in self._store.tests():
            if test.sibling == sibling:
                last = runs.setdefault(test.run, [])
                if test.test_id in done or test.test_id in self._executor.given_up:
                    last.clear()
                else:
                    last.append(test.test_id)
        for tests in runs.values():
            self._store.take_back(tests)


def _seed(*parts: int | str) -> int:
    """Derive a seed from its parts; 32 bits, so that every interface can carry it."""
    text = "/".join(map(str, parts)).encode()
    return int.from_bytes(hashlib.sha256(text).digest()[:4], "little")
