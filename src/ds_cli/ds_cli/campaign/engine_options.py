"""Options that choose what drives: engine, number of workers, cluster."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer

if TYPE_CHECKING:
    from ds_orchestrator.campaign.config import CampaignConfig
    from ds_orchestrator.campaign.drive_settings import DriveSettings
    from ds_orchestrator.engines.cluster import ClusterOptions

Workers = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="Graphs or processes that drive at the same time, instead of the configuration's; results do not depend "
        "on it.",
    ),
]
EngineName = Annotated[
    str | None,
    typer.Option(
        "--engine",
        help="What drives, instead of the configuration's: graph (nodes of ROS), local (processes without ROS) or dask "
        "(processes on a cluster); results do not depend on it.",
    ),
]
Scheduler = Annotated[
    str | None,
    typer.Option(help="With --engine dask: the scheduler, tls://HOST:PORT; a cluster on this machine if left out."),
]
Listen = Annotated[
    str, typer.Option(help="With --engine dask and no --scheduler: address on which further workers may join.")
]
TlsCa = Annotated[Path | None, typer.Option(help="Certificate of the cluster's authority, PEM.")]
TlsCert = Annotated[Path | None, typer.Option(help="Own certificate, PEM.")]
TlsKey = Annotated[Path | None, typer.Option(help="Key of the own certificate, PEM.")]
Unencrypted = Annotated[
    bool,
    typer.Option(
        "--unencrypted", help="Accept a cluster on a network without TLS, where anybody may run code on its machines."
    ),
]


def with_engine(config: CampaignConfig, workers: int | None, engine: str | None) -> CampaignConfig:
    """The configuration with another number of workers, or another engine."""
    return config.model_copy(update=_chosen(workers, engine))


def with_engine_without_ros(
    settings: DriveSettings, workers: int | None, engine: str | None, cluster: ClusterOptions
) -> DriveSettings:
    """The settings with an engine: `local` with one worker, which needs no ROS, unless another one is named."""
    return replace(settings, **{"engine": "local", "workers": 1, "cluster": cluster, **_chosen(workers, engine)})


def _chosen(workers: int | None, engine: str | None) -> dict[str, Any]:
    from ds_orchestrator.campaign.config import MOST_WORKERS, ConfigError
    from ds_orchestrator.campaign.drive_settings import EngineName as Names

    if workers is not None and workers > MOST_WORKERS:
        raise ConfigError(f"--workers {workers}: expected 1 to {MOST_WORKERS}")
    if engine is not None and engine not in get_args(Names):
        raise ConfigError(f"--engine {engine}: expected one of {', '.join(get_args(Names))}")
    changed = {"workers": workers, "engine": engine}
    return {key: value for key, value in changed.items() if value is not None}


def cluster_of(
    scheduler: str | None,
    listen: str,
    tls_ca: Path | None,
    tls_cert: Path | None,
    tls_key: Path | None,
    unencrypted: bool,
) -> ClusterOptions:
    """The cluster that the options describe."""
    from ds_orchestrator.engines.cluster import ClusterOptions

    return ClusterOptions(
        scheduler=scheduler,
        listen=listen,
        tls_ca=tls_ca,
        tls_cert=tls_cert,
        tls_key=tls_key,
        unencrypted=unencrypted,
    )
