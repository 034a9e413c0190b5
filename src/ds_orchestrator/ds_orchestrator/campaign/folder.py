# SPDX-License-Identifier: Apache-2.0
"""Campaign folder: its files, what its results depend on besides the configuration, and its content read once."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

from ds_base.bounded_file import load_json
from ds_base.folder_files import StoreError, check_name, make_folder, read_file, write_whole
from ds_base.installation import versions
from ds_base.intervals import FailureCount
from ds_driver.networks.driver_name import DriverName
from ds_orchestrator.campaign.config import CampaignConfig, ConfigError, parse_config
from ds_orchestrator.campaign.engine import DriveSettings
from ds_orchestrator.maps.campaign_maps import cells_of
from ds_orchestrator.search.features import Cell
from ds_orchestrator.store.model import Execution, Test
from ds_orchestrator.store.store import Store
from ds_sim.conditions.model import Conditions
from ds_sim.gates.gate import Gate
from ds_sim.registry import SimulatorName, make_simulator

STAGES = ("maps", "evaluation", "report")
"""Stages that compute results from the executions, in order."""
LIVE = ".live.json"
"""File that says what a running campaign does; see `ds_orchestrator.campaign.live_file`."""
ENGINE = ".engine.json"
"""File with what drove last: engine and workers, which belong to no result and so not to the store."""
_ENGINE_BYTES = 1000
WRITTEN = ("bags", "logs", "maps", "evaluation", "report.html")
"""Entries that a campaign writes into its folder beside the store."""


def open_store(folder: Path, *, writable: bool = False) -> Store:
    """Open the store of an existing campaign.

    Args:
        folder: campaign folder.
        writable: results may be written, under `ds_base.folder_files.locked`; without, nothing in the
            folder changes, and everything that is read is of one moment, even while the campaign runs.

    Raises:
        StoreError: the folder holds no campaign.
    """
    check_name(folder)
    if not folder.is_dir():
        raise StoreError(f"no folder {folder}: run a campaign there first")
    return Store(folder / "campaign.sqlite", read_only=not writable)


def prepare_folder(folder: Path) -> None:
    """Create a campaign folder if it is missing, and check that nothing else would be overwritten.

    Raises:
        StoreError: it cannot be created, or holds files that a campaign would overwrite.
    """
    make_folder(folder)
    foreign = [name for name in WRITTEN if (folder / name).exists()]
    if foreign and not (folder / "campaign.sqlite").exists():
        raise StoreError(f"{folder} holds {foreign[0]} but no campaign: choose another --out, or remove {foreign[0]}")


def store_of(folder: Path, config: CampaignConfig) -> Store:
    """Open the store of a campaign that starts or resumes with a configuration; refuses that of another one."""
    store = Store(folder / "campaign.sqlite", config=config.identity())
    try:
        _check(store, config)
    except StoreError:
        store.close()
        raise
    return store


def keep_engine(folder: Path, config: CampaignConfig) -> None:
    """Write what drives a campaign, so that it resumes in the same way."""
    write_whole(folder / ENGINE, json.dumps({"engine": config.engine, "workers": config.workers}).encode())


def with_kept_engine(folder: Path, config: CampaignConfig) -> CampaignConfig:
    """Let a campaign be driven by what drove it last; unchanged if that is not known."""
    try:
        kept = load_json(read_file(folder, ENGINE, _ENGINE_BYTES))
        kept = CampaignConfig.model_validate({key: kept[key] for key in ("engine", "workers")})
    except (OSError, ValueError, KeyError, TypeError):
        return config
    return config.model_copy(update={"engine": kept.engine, "workers": kept.workers})


def config_of(store: Store) -> CampaignConfig:
    """Read the configuration of a stored campaign, and check the store's names against it.

    Raises:
        ConfigError: the stored configuration is not valid.
        StoreError: the store has tests or executions that this campaign cannot have.
    """
    text, source = store.config, "the configuration in campaign.sqlite"
    try:
        raw = load_json(text)
    except ValueError:
        raise ConfigError(f"{source} is not JSON: restore the file from a copy") from None
    config = parse_config(raw, source, received=True)
    _check(store, config)
    return config


def _check(store: Store, config: CampaignConfig) -> None:
    store.check(config.siblings, config.simulators, runs=config.search.runs, budget=config.settings.budget)


DRIVER_SHA256 = "sha256 of the driver's weights"
"""Name of the fact that holds the digest of the driver's files."""
BACKEND = "back end of the network"
"""Name of the fact that holds what computes a network whose name does not say so."""


def record_provenance(store: Store, settings: DriveSettings, folder: Path) -> DriveSettings:
    """Record versions and digests; a campaign does not continue with another network or another car.

    Returns the settings with the back end on which the campaign began, so that it goes on with the same bits;
    ConfigError if the driver or a simulator has changed since then.
    """
    from ds_driver.networks.network_driver import BACKEND_BEFORE, driver_sha256, on_backend

    if settings.driver.has_files:
        weights = driver_sha256(settings.driver)
        notes = store.notes()
        driver = on_backend(settings.driver, notes.get(BACKEND, BACKEND_BEFORE if DRIVER_SHA256 in notes else ""))
        if driver != settings.driver:
            store.note(BACKEND, driver.backend)
        if store.note(DRIVER_SHA256, weights) != weights:
            raise ConfigError(
                f"the weights of {settings.driver} have changed since {folder} began: choose another --out"
            )
        settings = replace(settings, driver=driver)
    for name, version in versions().items():
        if store.note(f"version {name}", version) != version:
            store.note(f"version {name}, later", version)
    notes = store.notes()
    for name in settings.simulators:
        if "@" in name:
            key, content = f"car {name}", str(make_simulator(name).spec.extra.get("car", ""))
            if notes.get(key, content) != content:
                raise ConfigError(
                    f"{name}: the file has changed since the campaign began: restore it, or choose another --out"
                )
            store.note(key, content)
    return settings


@dataclass(frozen=True, kw_only=True)
class CampaignData:
    """Contents of a campaign's store at one moment, finished or not.

    Attributes:
        config: configuration as run.
        tests: every test, by sibling, run and number.
        executions: every execution, by simulator and test.
        gates: test and simulator -> what the gates say; tests that they exclude have no execution there.
        notes: facts such as versions and times.
        errors: attempts that ended in an error: test, simulator, attempt, outcome, message.
        given_up: tests whose search continued without their outcome.
        searches: runs of a search: sibling, run, method, seed.
        results: result -> number of executions from which it was computed.
    """

    config: CampaignConfig
    tests: tuple[Test, ...] = ()
    executions: tuple[Execution, ...] = ()
    gates: Mapping[tuple[str, SimulatorName], Gate] = field(default_factory=dict)
    notes: Mapping[str, str] = field(default_factory=dict)
    errors: tuple[tuple[str, SimulatorName, int, str, str], ...] = ()
    given_up: frozenset[str] = frozenset()
    searches: tuple[tuple[str, int, str, int], ...] = ()
    results: Mapping[str, int] = field(default_factory=dict)

    @property
    def driver(self) -> DriverName:
        """The driver with the back end that computed it, to drive it again with the same bits."""
        from ds_driver.networks.network_driver import BACKEND_BEFORE, on_backend

        return on_backend(self.config.driver, self.notes.get(BACKEND, BACKEND_BEFORE))

    @cached_property
    def verdicts(self) -> tuple[Execution, ...]:
        """Executions that ended in a verdict on the driver."""
        return tuple(e for e in self.executions if e.outcome.is_verdict)

    @cached_property
    def failed(self) -> dict[tuple[str, SimulatorName], bool]:
        """Test and simulator -> whether the driver failed, for verdicts alone."""
        return {(one.test_id, one.simulator): one.outcome.is_failure for one in self.verdicts}

    @cached_property
    def failures(self) -> dict[SimulatorName, FailureCount]:
        """Failures on every simulator, in the order of the configuration."""
        driven = Counter(simulator for _, simulator in self.failed)
        failing = Counter(simulator for (_, simulator), failed in self.failed.items() if failed)
        return {name: FailureCount(failing[name], driven[name]) for name in self.config.simulators}

    @cached_property
    def distinct(self) -> CampaignData:
        """The same campaign without repetitions: of scenarios that differ in their seeds alone, the first.

        Everything that counts or infers counts these. The paper's maps, and how far a campaign is, take all tests.
        """
        first: dict[tuple[str, Conditions], Test] = {}
        for test in self.tests:
            first.setdefault(test.scenario.unseeded, test)
        if len(first) == len(self.tests):
            return self
        ids = {test.test_id for test in first.values()}
        return replace(
            self,
            tests=tuple(first.values()),
            executions=tuple(one for one in self.executions if one.test_id in ids),
            gates={key: gate for key, gate in self.gates.items() if key[0] in ids},
            errors=tuple(error for error in self.errors if error[0] in ids),
            given_up=self.given_up & ids,
        )

    @cached_property
    def excluded(self) -> dict[tuple[str, SimulatorName], Gate]:
        """Test and simulator -> why no network can be judged by it there."""
        return {key: gate for key, gate in self.gates.items() if not gate.is_valid}

    @property
    def result_count(self) -> int:
        """Number of executions and gates, from which maps, evaluation and report are made."""
        return len(self.executions) + len(self.gates)

    @cached_property
    def cells(self) -> dict[str, Cell]:
        """Test -> cell over all features of the campaign, for tests that have one."""
        config = self.config
        return cells_of(
            self.tests,
            self.executions,
            features=config.features,
            maxitwo_compatible=config.maxitwo_compatible,
            gates=self.gates,
        )


def read_campaign(store: Store) -> CampaignData:
    """Read a campaign without its trajectories, each of which is read when it is first asked for.

    Raises:
        ds_orchestrator.store.sqlite_file.StoreError: the file is damaged.
        ds_orchestrator.campaign.config.ConfigError: its configuration is not valid.
    """
    # Executions first: a test is stored before its executions, so none is without its test while a campaign runs.
    executions, gates = tuple(store.executions()), store.gates()
    return CampaignData(
        config=config_of(store),
        tests=tuple(store.tests()),
        executions=executions,
        gates=gates,
        notes=store.notes(),
        errors=tuple(store.errors()),
        given_up=frozenset(store.given_up()),
        searches=tuple(store.searches()),
        results=store.results(),
    )


def read_folder(folder: Path) -> CampaignData:
    """Read the campaign in a folder; errors as in `open_store` and `read_campaign`."""
    with closing(open_store(folder)) as store:
        return read_campaign(store)
