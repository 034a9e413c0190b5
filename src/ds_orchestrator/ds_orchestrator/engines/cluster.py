"""Connects to a Dask cluster, or starts one on this machine; encrypted unless it cannot be reached from elsewhere."""

from __future__ import annotations

import ipaddress
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from ds_sim.installation import install_command

CONNECT_TIME = 10.0
"""Limit for reaching a scheduler, s; chosen: a loaded one answers in a second."""


class ClusterError(ValueError):
    """A cluster that cannot be used as it was asked for."""


@dataclass(frozen=True, kw_only=True)
class ClusterOptions:
    """Which cluster to use.

    Attributes:
        scheduler: address such as `tls://host:8786`; None for a cluster of its own on this machine.
        listen: address on which the scheduler of an own cluster listens for further workers.
        tls_ca: certificate of the authority, PEM.
        tls_cert: own certificate, PEM.
        tls_key: key of the own certificate, PEM.
        unencrypted: accept a network connection without encryption and authentication.
    """

    scheduler: str | None = None
    listen: str = "127.0.0.1"
    tls_ca: Path | None = None
    tls_cert: Path | None = None
    tls_key: Path | None = None
    unencrypted: bool = False

    def check(self) -> None:
        """Check the options against each other, before anything starts.

        Raises:
            ClusterError: an option is missing or does not go with another, or Dask is not installed.
        """
        files = {"--tls-ca": self.tls_ca, "--tls-cert": self.tls_cert, "--tls-key": self.tls_key}
        missing = [name for name, path in files.items() if path is None]
        if 0 < len(missing) < len(files):
            raise ClusterError(f"{', '.join(missing)} missing: TLS takes all of {', '.join(files)}")
        for name, path in files.items():
            if path is not None and not path.is_file():
                raise ClusterError(f"{name} {path}: no such file: expected a PEM file")
        if self.scheduler is not None:
            self._check_address(self.scheduler)
        elif not self.encrypted and not _is_loopback(self.listen) and not self.unencrypted:
            raise ClusterError(
                f"--listen {self.listen} without TLS lets anybody on that network run code on this machine: give "
                "--tls-ca, --tls-cert and --tls-key, or say --unencrypted"
            )
        try:
            import_module("distributed")
        except ImportError:
            raise ClusterError(f"Dask is not installed: type {install_command('dask')}") from None

    @property
    def encrypted(self) -> bool:
        """Whether TLS files were given."""
        return self.tls_ca is not None

    def _check_address(self, address: str) -> None:
        try:
            parts = urlsplit(address)
            usable = parts.scheme in ("tcp", "tls") and bool(parts.hostname) and bool(parts.port)
        except ValueError:
            usable = False
        if not usable:
            raise ClusterError(f"--scheduler {address!r:.100}: expected tls://HOST:PORT or tcp://HOST:PORT")
        if parts.scheme == "tls" and not self.encrypted:
            raise ClusterError(f"--scheduler {address} needs --tls-ca, --tls-cert and --tls-key")
        if parts.scheme == "tcp" and self.encrypted:
            raise ClusterError(f"--scheduler {address} is not encrypted: expected tls://, or leave out the TLS files")
        if parts.scheme == "tcp" and not _is_loopback(parts.hostname or "") and not self.unencrypted:
            raise ClusterError(
                f"--scheduler {address} is neither encrypted nor on this machine, so anybody on the network could "
                "answer in its place: use tls:// with --tls-ca, --tls-cert and --tls-key, or say --unencrypted"
            )

    def security(self) -> Any:
        """`distributed.Security` of these options, or None."""
        if not self.encrypted:
            return None
        distributed: Any = import_module("distributed")
        ca, cert, key = str(self.tls_ca), str(self.tls_cert), str(self.tls_key)
        roles = {f"tls_{role}_{part}": f for role in ("client", "scheduler", "worker")
                 for part, f in (("cert", cert), ("key", key))}  # fmt: skip
        return distributed.Security(tls_ca_file=ca, require_encryption=True, **roles)


def connect(address: str, options: ClusterOptions, *, limit: float = CONNECT_TIME) -> Any:
    """Connect to a scheduler and return the `distributed.Client`.

    Raises:
        ClusterError: there is no scheduler, or it does not accept the certificate.
    """
    distributed: Any = import_module("distributed")
    try:
        return distributed.Client(address, timeout=limit, security=options.security(), set_as_default=False)
    except (OSError, TimeoutError, ValueError, RuntimeError) as error:
        causes: list[BaseException] = []
        cause: BaseException | None = error
        while cause is not None and len(causes) < 10:
            causes.append(cause)
            cause = cause.__cause__ or cause.__context__
        tls = next((c for c in causes if "certificate" in str(c).lower() or "ssl" in str(c).lower()), None)
        if tls is not None:
            what = " ".join(str(tls).split())[:200]
            raise ClusterError(f"{address} refuses this TLS connection ({what}): check the three TLS files") from None
        raise ClusterError(f"no scheduler answers at {address} within {limit:.0f} s: is it running?") from None


@contextmanager
def own_cluster(workers: int, options: ClusterOptions, folder: Path) -> Iterator[str]:
    """Start a scheduler and workers on this machine, yield the scheduler's address, and end them.

    Args:
        workers: number of workers, each with one thread.
        options: where the scheduler listens, and TLS.
        folder: folder for the workers' files.
    """
    dask: Any = import_module("dask")
    distributed: Any = import_module("distributed")
    # The dashboard has no authentication.
    with (
        dask.config.set({"distributed.worker.memory.terminate": False, "distributed.worker.memory.pause": False}),
        distributed.LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            host=options.listen,
            protocol="tls://" if options.encrypted else "tcp://",
            security=options.security(),
            dashboard_address=None,
            worker_dashboard_address=None,
            local_directory=str(folder),
            silence_logs=50,
        ) as cluster,
    ):
        yield str(cluster.scheduler_address)


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
