# SPDX-License-Identifier: Apache-2.0
"""Runs a campaign from its configuration to its report, and opens one that was run before."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from ds_analysis.paper.correlation import Correlation
from ds_analysis.paper.paper_tables import read_correlations
from ds_base.folder_files import enter_folder, locked
from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.executor import Listener, Stopped, StopSwitch
from ds_orchestrator.campaign.folder import (
    keep_engine,
    open_store,
    prepare_folder,
    read_campaign,
    record_provenance,
    store_of,
)
from ds_orchestrator.campaign.live_file import LiveFile
from ds_orchestrator.campaign.runner import Campaign
from ds_orchestrator.campaign.status import is_driven
from ds_orchestrator.engines.cluster import ClusterOptions
from ds_orchestrator.engines.start import preflight, running_engine
from ds_report.build import NOT_MADE, write_all
from ds_report.first_screen import FirstScreen, first_screen

FIRST_TESTS = 8
"""Tests of a first answer; chosen: with three simulators, 2.5 minutes of processor time on a slow machine."""


@dataclass(frozen=True, kw_only=True)
class CampaignOutcome:
    """Outcome of a campaign: executions with a verdict, and those of this session that ended in an error."""

    folder: Path
    report: Path
    tests: int
    executions: int
    executions_in_error: int
    correlations: Sequence[Correlation]
    answer: FirstScreen


def run_campaign(
    config: CampaignConfig,
    folder: Path,
    listener: Listener | None = None,
    *,
    attach: bool = False,
    cluster: ClusterOptions | None = None,
    stop: StopSwitch | None = None,
    first: Callable[[CampaignOutcome], None] | None = None,
) -> CampaignOutcome:
    """Run a campaign to its report, or resume the one in the folder.

    Args:
        config: what to run.
        folder: campaign folder, created if missing.
        listener: called from several threads.
        attach: use the nodes that are already running in this environment's ROS domain instead of starting any.
        cluster: cluster of the engine `dask`; one on this machine if None.
        stop: ends driving from another thread.
        first: receives an outcome with its report after some random roads of each search, `FIRST_TESTS` in all, unless
            an earlier session wrote a report, or only elites migrate. The campaign then goes on, and ends the same.

    Raises:
        ConfigError: the driver or a simulator of the configuration has changed since the campaign began.
        ds_orchestrator.store.sqlite_file.StoreError: the folder cannot be used.
        ds_base.folder_files.LockError: another process uses the folder.
        ds_orchestrator.campaign.executor.Stopped: the campaign was interrupted; what was finished is kept.
    """
    settings = config.drive_settings(cluster=cluster, attach=attach)
    preflight(settings)
    prepare_folder(folder)
    with locked(folder), closing(store_of(folder, config)) as store, LiveFile(folder, listener or Listener()) as live:
        settings = record_provenance(store, settings, folder)
        keep_engine(folder, config)
        enter_folder(folder / "bags")

        def outcome(in_error: int) -> CampaignOutcome:
            # The simulators come from the caller's configuration, so their code is trusted.
            data = read_campaign(store)
            report = write_all(folder, store, data=data, again=False, listener=live, trusted=config.simulators)
            return CampaignOutcome(
                folder=folder,
                report=report,
                tests=len(data.tests),
                executions=store.count_executions(),
                executions_in_error=in_error,
                correlations=read_correlations(folder, config) if config.twin else [],
                answer=first_screen(data, str(folder)),
            )

        if is_driven(store, config):
            return outcome(0)
        tests = min(config.search.population, max(1, FIRST_TESTS // (config.search.runs * len(config.siblings))))
        has_answer = store.results().get("report", NOT_MADE) != NOT_MADE
        is_short = has_answer or config.elites_only or tests >= config.settings.budget

        try:
            with running_engine(settings, logs=folder / "logs") as engine:
                driven = config.model_copy(update={"driver": settings.driver})
                campaign = Campaign(driven, folder, store, engine, live)
                (stop or StopSwitch()).connect(campaign.stop, engine.stop)
                try:
                    if first is not None and not is_short:
                        campaign.run(tests)
                        first(outcome(campaign.failed_executions))
                    campaign.run()
                except BaseException:
                    engine.stop()
                    raise
        except KeyboardInterrupt:
            raise Stopped from None
        return outcome(campaign.failed_executions)


def rebuild_report(folder: Path, listener: Listener | None = None, *, trusted: Collection[str] = ()) -> Path:
    """Write a campaign's results again; returns the report's path.

    `StoreError` if the folder holds no campaign or one that cannot be used, `LockError` if another process uses it.
    """
    with closing(open_store(folder, writable=True)) as store, locked(folder):
        return write_all(folder, store, listener=listener, trusted=trusted)


def check_trust(config: CampaignConfig, trusted: Collection[str]) -> None:
    """Refuse a configuration, which may have been received, whose driver or simulators are code that is not trusted."""
    from ds_driver.networks.driver_name import received_driver
    from ds_sim.registry import received_simulator

    for name in config.simulators:
        received_simulator(name, confirmed=trusted)
    received_driver(config.driver, confirmed=trusted)
