# SPDX-License-Identifier: Apache-2.0
"""Starts the engine that drives."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path

from ds_orchestrator.campaign.engine import DriveSettings, Engine


def running_engine(settings: DriveSettings, *, logs: Path) -> AbstractContextManager[Engine]:
    """Context manager that starts an engine, yields it, and stops it.

    Args:
        settings: what is driven, by which engine.
        logs: folder for the logs of the engine's processes.
    """
    if settings.engine == "local":
        from ds_orchestrator.engines.local import running_local

        return running_local(
            settings.driver, workers=settings.workers, command_timeout=settings.command_timeout, logs=logs
        )
    if settings.engine == "dask":
        from ds_orchestrator.engines.dask_engine import running_dask

        return running_dask(settings, folder=logs / "dask")
    from ds_orchestrator.graph.session import running_graphs

    return running_graphs(settings, logs=logs)
