# SPDX-License-Identifier: Apache-2.0
"""Drives given tests with one driver, on any engine; what was driven is kept, so that a stopped run goes on."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

from ds_base.folder_files import locked, make_folder
from ds_base.progress import logger_of
from ds_orchestrator.campaign.engine import DriveSettings
from ds_orchestrator.campaign.executor import Executor, Listener, Stopped, StopSwitch
from ds_orchestrator.campaign.folder import record_provenance
from ds_orchestrator.engines.fingerprint import code_sha256
from ds_orchestrator.engines.start import preflight, running_engine
from ds_orchestrator.store.model import NO_ORIGIN, Execution, Test
from ds_orchestrator.store.store import Store
from ds_sim.gates.gate import Gate
from ds_sim.registry import SimulatorName
from ds_sim.simulator import Outcome

LOG = logger_of(__name__)
DRIVES_FILE = "drives.sqlite"
"""Store of drives of given tests; not a campaign's file, as no search can resume from it."""
Key = tuple[str, SimulatorName]
"""Test and simulator."""


@dataclass(frozen=True, kw_only=True)
class Callbacks:
    """Who hears how far a batch of drives is, and who may end it.

    Attributes:
        listen: makes a listener, which receives every finished drive of one driver on one set of tests.
        stop: ends driving from another thread.
    """

    listen: Callable[[], AbstractContextManager[Listener]] = lambda: nullcontext(Listener())
    stop: StopSwitch = field(default_factory=StopSwitch)


class Unfinished(NamedTuple):
    """A drive without a verdict: how its last attempt ended, None if there was none, and its message."""

    outcome: Outcome | None = None
    message: str = ""

    def __str__(self) -> str:
        return "not driven" if self.outcome is None else f"{self.outcome.name}: {self.message}"


@dataclass(frozen=True, kw_only=True)
class DriveResults:
    """What became of given tests.

    Attributes:
        executions: drives with a verdict.
        gates: what is known of the tests' validity.
        errors: drives without a verdict.
    """

    executions: Mapping[Key, Execution] = field(default_factory=dict)
    gates: Mapping[Key, Gate] = field(default_factory=dict)
    errors: Mapping[Key, Unfinished] = field(default_factory=dict)

    @property
    def excluded(self) -> set[Key]:
        """Tests by which no network can be judged."""
        return {key for key, gate in self.gates.items() if not gate.is_valid}


def drive_tests(
    settings: DriveSettings,
    work: Mapping[SimulatorName, Sequence[Test]],
    folder: Path,
    callbacks: Callbacks | None = None,
    *,
    gates: Mapping[Key, Gate] | None = None,
) -> DriveResults:
    """Drive given tests, or read from the folder what was driven before.

    Args:
        settings: how they are driven.
        work: simulator -> tests.
        folder: for the drives, created if missing.
        callbacks: who hears of it; nobody if None.
        gates: what is known of the tests' validity, so that the autopilot does not drive them again.

    Raises:
        ConfigError: something cannot be driven so, or the driver or a simulator's file has changed since the folder
            began.
        ds_orchestrator.store.sqlite_file.StoreError: the folder holds drives of another driver or of other tests.
        ds_orchestrator.campaign.executor.Stopped: the user stopped it; what was finished is kept.
    """
    callbacks = callbacks or Callbacks()
    preflight(settings)
    tests = {test.test_id: test for of in work.values() for test in of}
    with open_drives(settings, folder, tests=list(tests.values())) as (store, settings):
        for test in tests.values():
            store.add_test(test)
        for (test_id, simulator), gate in (gates or {}).items():
            if test_id in tests and simulator in work:
                store.add_gate(test_id, simulator, gate)
        drives = _read(store, work)
        if not drives.errors:
            return drives
        own = {name: sum(test.sibling == name for test in of) for name, of in work.items()}
        try:
            with running_engine(settings, logs=folder / "logs") as engine, callbacks.listen() as listener:
                listener.expect([own, {name: len(of) - own[name] for name, of in work.items()}])
                listener.stage("given tests")
                executor = Executor(settings, folder, store, engine, listener)
                callbacks.stop.connect(executor.stop, engine.stop)
                executor.execute_all(work)
        except KeyboardInterrupt:
            raise Stopped from None
        return _read(store, work)


@contextmanager
def open_drives(
    settings: DriveSettings, folder: Path, *, tests: Sequence[Test] = ()
) -> Iterator[tuple[Store, DriveSettings]]:
    """Open and lock the store of a folder of given tests, created if missing; its driver names its back end.

    Errors are those of `drive_tests`.
    """
    make_folder(folder)
    with locked(folder), closing(Store(folder / DRIVES_FILE, config=settings.identity())) as store:
        store.check(
            {*settings.simulators, NO_ORIGIN.sibling, *(test.sibling for test in tests)},
            settings.simulators,
            runs=1 + max((test.run for test in tests), default=0),
            budget=max(1, len(tests), *(1 + test.number for test in tests)),
        )
        settings = record_provenance(store, settings, folder)
        if store.note("code", (code := code_sha256())) != code:
            LOG.warning("the code has changed since %s began: its drives are kept, another --out has none", folder)
        yield store, settings


def read_drives(folder: Path, work: Mapping[SimulatorName, Sequence[Test]]) -> DriveResults:
    """Read what became of given tests so far, as `drive_tests` does, and drive nothing."""
    if not (folder / DRIVES_FILE).exists():
        return DriveResults(errors={(test.test_id, name): Unfinished() for name, of in work.items() for test in of})
    with closing(Store(folder / DRIVES_FILE, read_only=True)) as store:
        return _read(store, work)


def _read(store: Store, work: Mapping[SimulatorName, Sequence[Test]]) -> DriveResults:
    wanted = {(test.test_id, name) for name, tests in work.items() for test in tests}
    executions = {(one.test_id, one.simulator): one for one in store.executions()}
    last = {(test, name): Unfinished(Outcome[outcome], message) for test, name, _, outcome, message in store.errors()}
    results = DriveResults(
        executions={key: one for key, one in executions.items() if key in wanted and one.outcome.is_verdict},
        gates={key: gate for key, gate in store.gates().items() if key in wanted},
    )
    missing = wanted - set(executions) - results.excluded
    return replace(results, errors={key: last.get(key, Unfinished()) for key in missing})
