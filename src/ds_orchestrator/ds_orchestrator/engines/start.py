# SPDX-License-Identifier: Apache-2.0
"""Checks that tests can be driven as they are to be, and starts the engine that drives them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path

from ds_base.installation import missing_module
from ds_driver.networks.driver_name import AUTOPILOT, DriverName
from ds_orchestrator.campaign.config import ConfigError
from ds_orchestrator.campaign.engine import BAG_MODULES, DriveSettings, Engine, EngineName, usual_record
from ds_orchestrator.engines.cluster import ClusterOptions
from ds_orchestrator.graph.supervisor import check_ros
from ds_sim.conditions.model import NotApplicableError
from ds_sim.registry import SimulatorName, make_simulator, spec_of


def preflight(settings: DriveSettings) -> None:
    """Check engine, driver, simulators and conditions.

    ConfigError if an option does not go with the engine, or a simulator cannot realise the conditions; ClusterError,
    RosMissingError, or the errors of `check_driver`.
    """
    engine = settings.engine
    if settings.attach and engine != "graph":
        raise ConfigError(f"engine: {engine} starts no nodes: leave out --attach, or set it to graph")
    if settings.attach and settings.workers > 1:
        raise ConfigError(
            f"workers: {settings.workers} cannot be used with --attach: set it to 1, or leave out --attach"
        )
    if engine != "dask" and settings.cluster != ClusterOptions():
        raise ConfigError(f"engine: {engine} uses no cluster: set it to dask (--engine dask)")
    if engine == "graph":
        check_ros()
    if engine == "dask":
        settings.cluster.check()
    if settings.record != "none" and usual_record() == "none":
        raise ConfigError(f"record: {settings.record} writes bags: {missing_module(BAG_MODULES[0])}, or set it to none")
    check_driver(settings.driver, settings.simulators, attach=settings.attach)
    for name in settings.simulators:
        simulator = make_simulator(name)
        simulator.close()
        try:
            simulator.spec.check(settings.conditions)
        except NotApplicableError as error:
            raise ConfigError(f"conditions: {error}: leave the simulator or the condition out") from None


def check_driver(driver: DriverName, simulators: Sequence[SimulatorName], *, attach: bool = False) -> None:
    """Check a driver and the simulators that it will drive; where running nodes drive, one may be this driver.

    ValueError if the name is unknown, its file cannot be used, or it has no generator for a simulator's images.
    """
    if driver == AUTOPILOT or (attach and driver.is_node):
        return
    from ds_driver.networks.network_driver import load_pilot

    translation = load_pilot(driver).translation
    if translation is not None:
        for name in simulators:
            translation.generator(spec_of(name).name)


Start = Callable[[DriveSettings, Path], AbstractContextManager[Engine]]
"""Starts an engine, given how it drives and a folder for the logs of its processes; the context stops it."""


def _local(settings: DriveSettings, logs: Path) -> AbstractContextManager[Engine]:
    from ds_orchestrator.engines.local import running_local

    return running_local(settings.driver, workers=settings.workers, command_timeout=settings.command_timeout, logs=logs)


def _dask(settings: DriveSettings, logs: Path) -> AbstractContextManager[Engine]:
    from ds_orchestrator.engines.dask_engine import running_dask

    return running_dask(settings, folder=logs / "dask")


def _graph(settings: DriveSettings, logs: Path) -> AbstractContextManager[Engine]:
    from ds_orchestrator.graph.session import running_graphs

    return running_graphs(settings, logs=logs)


ENGINES: dict[EngineName, Start] = {"graph": _graph, "local": _local, "dask": _dask}
"""Name in a configuration -> what starts that engine."""


def running_engine(settings: DriveSettings, *, logs: Path) -> AbstractContextManager[Engine]:
    """Context manager that starts an engine, yields it, and stops it; its processes log into a folder."""
    return ENGINES[settings.engine](settings, logs)
