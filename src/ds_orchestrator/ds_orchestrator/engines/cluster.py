# SPDX-License-Identifier: Apache-2.0
"""Connects to a Dask cluster, or starts one on this machine; encrypted unless it cannot be reached from elsewhere."""

from __future__ import annotations

import ipaddress
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from pydantic import FilePath, ValidationError

from ds_base.config_errors import Keys, problems, read_keys
from ds_base.errors import InputError
from ds_base.installation import install_command
from ds_sim.registry import path_moved

CONNECT_TIME = 10.0
"""Limit for reaching a scheduler, s; chosen: a loaded one answers in a second."""


class ClusterError(InputError):
    """A cluster that cannot be used as it was asked for."""


class TlsFiles(Keys):
    """PEM files of one side of an encrypted connection: the authority's certificate, the own one, and its key."""

    ca: FilePath
    cert: FilePath
    key: FilePath


class ClusterOptions(Keys):
    """Which cluster to use: the keys of the file that `--cluster` names."""

    scheduler: str | None = None  # address such as `tls://host:8786`; None for a cluster of its own on this machine
    listen: str = "127.0.0.1"  # address on which the scheduler of an own cluster listens for further workers
    tls: TlsFiles | None = None  # files of a connection with encryption and authentication; None for one without
    unencrypted: bool = False  # accept a network connection without encryption and authentication

    def check(self) -> None:
        """Check the options against each other, before anything starts.

        Raises:
            ClusterError: an option does not go with another, or Dask is not installed.
        """
        if self.scheduler is not None:
            self._check_address(self.scheduler)
        elif self.tls is None and not _is_loopback(self.listen) and not self.unencrypted:
            raise ClusterError(
                f"listen: {self.listen} without TLS lets anybody on that network run code on this machine: give the "
                "files of tls, or say unencrypted: true"
            )
        try:
            import_module("distributed")
        except ImportError:
            raise ClusterError(f"Dask is not installed: type {install_command('dask')}") from None

    def _check_address(self, address: str) -> None:
        try:
            parts = urlsplit(address)
            usable = parts.scheme in ("tcp", "tls") and bool(parts.hostname) and bool(parts.port)
        except ValueError:
            usable = False
        if not usable:
            raise ClusterError(f"scheduler: {address!r:.100}, expected tls://HOST:PORT or tcp://HOST:PORT")
        if parts.scheme == "tls" and self.tls is None:
            raise ClusterError(f"scheduler: {address} needs the files of tls: ca, cert and key")
        if parts.scheme == "tcp" and self.tls is not None:
            raise ClusterError(f"scheduler: {address} is not encrypted, expected tls://, or no tls files")
        if parts.scheme == "tcp" and not _is_loopback(parts.hostname or "") and not self.unencrypted:
            raise ClusterError(
                f"scheduler: {address} is neither encrypted nor on this machine, so anybody on the network could "
                "answer in its place: use tls:// with the files of tls, or say unencrypted: true"
            )

    def security(self) -> Any:
        """`distributed.Security` of these options, or None."""
        if self.tls is None:
            return None
        distributed: Any = import_module("distributed")
        files = {"cert": str(self.tls.cert), "key": str(self.tls.key)}
        roles = {f"tls_{role}_{part}": files[part] for role in ("client", "scheduler", "worker") for part in files}
        return distributed.Security(tls_ca_file=str(self.tls.ca), require_encryption=True, **roles)


def read_cluster(path: Path) -> ClusterOptions:
    """Read the file that `--cluster` names, such as `scheduler: tcp://127.0.0.1:8786`; its paths are relative to it.

    Raises:
        ClusterError: one line with the key, what is wrong with it, and what is allowed.
    """
    raw = read_keys(path, ClusterError)
    if isinstance(raw, dict) and isinstance(raw.get("tls"), dict):
        files = {key: file for key, file in raw["tls"].items() if isinstance(file, str)}
        moved = {key: path_moved(file, path.parent, Path()) for key, file in files.items()}
        raw = {**raw, "tls": raw["tls"] | moved}
    try:
        return ClusterOptions.model_validate(raw)
    except ValidationError as error:
        raise ClusterError(f"{path}: {problems(error, ClusterOptions)}") from None


def connect(address: str, options: ClusterOptions, *, limit: float = CONNECT_TIME) -> Any:
    """Connect to a scheduler and return the `distributed.Client`, or raise `ClusterError`."""
    distributed: Any = import_module("distributed")
    try:
        return distributed.Client(address, timeout=limit, security=options.security(), set_as_default=False)
    except (OSError, TimeoutError, ValueError, RuntimeError) as error:
        tls = next((c for c in _causes(error) if "certificate" in str(c).lower() or "ssl" in str(c).lower()), None)
        if tls is not None:
            what = " ".join(str(tls).split())[:200]
            raise ClusterError(f"{address} refuses this TLS connection ({what}): check the files of tls") from None
        raise ClusterError(f"no scheduler answers at {address} within {limit:.0f} s: is it running?") from None


@contextmanager
def own_cluster(workers: int, options: ClusterOptions, folder: Path) -> Iterator[str]:
    """Start a scheduler and workers of one thread on this machine, yield the scheduler's address, and end them."""
    dask: Any = import_module("dask")
    distributed: Any = import_module("distributed")
    # Results are fetched at once, so that workers need neither limits of memory nor a place on the disk for more.
    limits = {f"distributed.worker.memory.{what}": False for what in ("target", "spill", "pause", "terminate")}
    with dask.config.set(limits):
        try:
            # The dashboard has no authentication.
            cluster = distributed.LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                processes=True,
                host=options.listen,
                protocol="tls://" if options.tls else "tcp://",
                security=options.security(),
                dashboard_address=None,
                worker_dashboard_address=None,
                local_directory=str(folder),
                silence_logs=50,
            )
        except RuntimeError as error:  # of a worker, whose own error is the cause
            problem = next((cause for cause in _causes(error) if isinstance(cause, OSError)), None)
            if problem is None:
                raise
            raise ClusterError(f"workers of dask cannot be started in {folder}: {problem.strerror}") from None
        with cluster:
            yield str(cluster.scheduler_address)


def _causes(error: BaseException) -> list[BaseException]:
    """The error and those that led to it, ten at most."""
    causes, cause = [error], error.__cause__ or error.__context__
    while cause is not None and len(causes) < 10:
        causes.append(cause)
        cause = cause.__cause__ or cause.__context__
    return causes


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
