"""Starts the engine that a campaign's configuration names."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from ds_driver.closed_loop.simulation import AUTOPILOT
from ds_orchestrator.campaign.config import CampaignConfig, ConfigError
from ds_orchestrator.campaign.gatekeeper import GateDriver
from ds_orchestrator.campaign.runner import Executor
from ds_orchestrator.engines.cluster import ClusterOptions
from ds_orchestrator.graph.availability import check_ros
from ds_orchestrator.search.objectives import OBJECTIVES


def check_engine(config: CampaignConfig, cluster: ClusterOptions, *, attach: bool) -> None:
    """Check that the engine can do what is asked of it, before anything starts.

    Raises:
        ConfigError: an option does not go with the engine.
        ds_orchestrator.engines.cluster.ClusterError: the cluster's options do not go together.
        ds_orchestrator.graph.availability.RosMissingError: the engine needs nodes, and ROS is not installed.
    """
    if config.engine == "graph" and OBJECTIVES[config.search.objective].everywhere:
        raise ConfigError(
            f"search.objective: {config.search.objective} drives a test on several simulators at once, which the "
            "engine graph does not: expected engine: local or dask"
        )
    if attach and config.engine != "graph":
        raise ConfigError(f"engine: {config.engine} starts no nodes: leave out --attach, or set it to graph")
    if attach and config.workers > 1:
        raise ConfigError(f"workers: {config.workers} cannot be used with --attach: set it to 1, or leave out --attach")
    if config.engine != "dask" and cluster != ClusterOptions():
        raise ConfigError(f"engine: {config.engine} uses no cluster: set it to dask (--engine dask)")
    if config.engine == "graph":
        check_ros()
    if config.engine == "dask":
        cluster.check()


def running_engine(
    config: CampaignConfig,
    namespaces: dict[str, str],
    *,
    logs: Path,
    attach: bool,
    cluster: ClusterOptions,
    say: Callable[[str], None],
) -> AbstractContextManager[Executor]:
    """Context manager that starts the engine, yields its executor, and stops it.

    Args:
        config: configuration of the campaign.
        namespaces: simulator name -> ROS namespace.
        logs: folder for the logs of the engine's processes.
        attach: use running nodes.
        cluster: cluster of the engine `dask`.
        say: called with one line about workers that come and go.
    """
    driver, timeout = config.driver, config.command_timeout
    if config.engine == "local":
        from ds_orchestrator.engines.local import running_local

        return running_local(driver, workers=config.workers, command_timeout=timeout, logs=logs)
    if config.engine == "dask":
        from ds_orchestrator.engines.dask_engine import running_dask

        return running_dask(
            driver,
            config.simulators,
            workers=config.workers,
            command_timeout=timeout,
            folder=logs / "dask",
            options=cluster,
            say=say,
        )
    from ds_orchestrator.graph.session import running_graph, running_workers

    if config.workers > 1:
        return running_workers(config.workers, namespaces, driver, command_timeout=timeout, logs=logs)
    return running_graph(namespaces, driver, command_timeout=timeout, logs=logs, attach=attach, draw="seen")


def running_gate_driver(
    config: CampaignConfig, executor: Executor, *, logs: Path
) -> AbstractContextManager[GateDriver | None]:
    """Context manager that yields what drives the autopilot for the gates, if the campaign has any.

    Engines without ROS drive it beside the driver; beside a graph, worker processes do, whose drives are the same.

    Args:
        config: configuration of the campaign.
        executor: executor of the engine.
        logs: folder for the logs of further processes.
    """
    if not config.has_gates:
        return nullcontext()
    if isinstance(executor, GateDriver):
        return nullcontext(executor)
    from ds_orchestrator.engines.local import running_local

    return running_local(AUTOPILOT, workers=config.workers, command_timeout=config.command_timeout, logs=logs)
