# SPDX-License-Identifier: Apache-2.0
"""Starts the engine that drives."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

from ds_orchestrator.campaign.engine import DriveSettings, Engine, EngineName

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
