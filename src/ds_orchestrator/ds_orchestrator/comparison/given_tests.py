"""Drives given tests with one driver, on any engine; what was driven is kept, so that a stopped comparison goes on."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, closing
from dataclasses import dataclass, field
from pathlib import Path

from ds_orchestrator.campaign.config import CampaignConfig, ConfigError
from ds_orchestrator.campaign.folder import locked
from ds_orchestrator.campaign.provenance import record_provenance
from ds_orchestrator.campaign.refined_data import DRIVES_FILE
from ds_orchestrator.campaign.runner import Campaign, Listener, Stopped
from ds_orchestrator.engines.cluster import ClusterOptions
from ds_orchestrator.engines.fingerprint import code_sha256
from ds_orchestrator.engines.start import check_engine, running_engine, running_gate_driver
from ds_orchestrator.graph.process_specs import check_driver, namespaces_of
from ds_orchestrator.search.objectives import OBJECTIVES
from ds_orchestrator.store.model import Execution, Test
from ds_orchestrator.store.store import Store
from ds_sim.conditions.loading import check_applicable
from ds_sim.conditions.model import NotApplicableError
from ds_sim.gates.gate import Gate
from ds_sim.registry import spec_of

Key = tuple[str, str]
"""Test and simulator."""


@dataclass(frozen=True, kw_only=True)
class Engine:
    """What drives, and what hears of it.

    Attributes:
        listen: makes a listener, which receives every finished drive of one driver on one set of tests.
        cluster: cluster of the engine `dask`.
        say: called with one line about workers that come and go.
    """

    listen: Callable[[], AbstractContextManager[Listener]]
    cluster: ClusterOptions = field(default_factory=ClusterOptions)
    say: Callable[[str], None] = lambda line: None


@dataclass(frozen=True, kw_only=True)
class GivenDrives:
    """What became of given tests.

    Attributes:
        executions: drives with a verdict.
        excluded: tests by which no network can be judged.
        errors: why a drive without a verdict has none.
    """

    executions: Mapping[Key, Execution] = field(default_factory=dict)
    excluded: Mapping[Key, Gate] = field(default_factory=dict)
    errors: Mapping[Key, str] = field(default_factory=dict)


def drive_tests(
    config: CampaignConfig,
    work: Mapping[str, Sequence[Test]],
    folder: Path,
    engine: Engine,
    *,
    gates: Mapping[Key, Gate] | None = None,
) -> GivenDrives:
    """Drive given tests with the configuration's driver, or read from the folder what was driven before.

    Args:
        config: driver, simulators, engine and retries; its search bounds the tests' runs and numbers.
        work: simulator -> tests.
        folder: for the drives, created if missing.
        engine: what drives.
        gates: what is known of the tests' validity, so that the autopilot does not drive them again.

    Raises:
        ConfigError: the driver, or a simulator's file, has changed since the folder began.
        ds_orchestrator.store.sqlite_file.StoreError: the folder holds drives of another driver or of other tests.
        ds_orchestrator.campaign.runner.Stopped: the user stopped it; what was finished is kept.
    """
    # No search takes place, so one that would need several simulators at once is none.
    search = config.search.model_copy(update={"objective": next(iter(OBJECTIVES))})
    config = config.model_copy(update={"search": search, "record": "none"})
    check_engine(config, engine.cluster, attach=False)
    check_driver(config.driver, config.simulators)
    for name in work:
        try:
            check_applicable(config.fixed_conditions, spec_of(name))
        except NotApplicableError as error:
            raise ConfigError(f"conditions: {error}: leave the simulator or the condition out") from None
    folder.mkdir(parents=True, exist_ok=True)
    with (
        locked(folder),
        closing(Store(folder / DRIVES_FILE, config=config.identity(), conditions=config.has_gates)) as store,
    ):
        store.check(config.siblings, config.simulators, runs=config.search.runs, budget=config.settings.budget)
        record_provenance(store, config, folder)
        if store.note("code", (code := code_sha256())) != code:
            engine.say(f"the code has changed since {folder} began: its drives are kept, another --out has none")
        if _read(store, work).errors:
            _drive(config, work, folder, store, engine, gates or {})
        return _read(store, work)


def _drive(
    config: CampaignConfig,
    work: Mapping[str, Sequence[Test]],
    folder: Path,
    store: Store,
    engine: Engine,
    gates: Mapping[Key, Gate],
) -> None:
    tests = {test.test_id: test for of in work.values() for test in of}
    for test in tests.values():
        store.add_test(test)
    for (test_id, simulator), gate in gates.items():
        if test_id in tests and simulator in work and store.keeps_conditions:
            store.add_gate(test_id, simulator, gate)
    namespaces, logs = namespaces_of(config.siblings, config.twin), folder / "logs"
    try:
        with (
            running_engine(
                config, namespaces, logs=logs, attach=False, cluster=engine.cluster, say=engine.say
            ) as executor,
            running_gate_driver(config, executor, logs=logs / "gates") as gate_driver,
            engine.listen() as listener,
        ):  # fmt: skip
            campaign = Campaign(config, folder, store, executor, listener, namespaces, gate_driver)
            try:
                campaign.drive(work)
            except BaseException:
                executor.stop()
                raise
    except KeyboardInterrupt:
        raise Stopped from None


def _read(store: Store, work: Mapping[str, Sequence[Test]]) -> GivenDrives:
    wanted = {(test.test_id, name) for name, tests in work.items() for test in tests}
    executions = {(one.test_id, one.simulator): one for one in store.executions()}
    excluded = {key: gate for key, gate in store.gates().items() if not gate.is_valid}
    reasons = {(test, name): f"{outcome}: {message}" for test, name, _, outcome, message in store.errors()}
    missing = wanted - set(executions) - set(excluded)
    return GivenDrives(
        executions={key: one for key, one in executions.items() if key in wanted and one.outcome.is_verdict},
        excluded={key: gate for key, gate in excluded.items() if key in wanted},
        errors={key: reasons.get(key, "not driven") for key in missing},
    )
