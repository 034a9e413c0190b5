# SPDX-License-Identifier: Apache-2.0
"""The engine `dask`, with real schedulers and workers: same bytes whoever dies, joins late, or computes otherwise."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.waiting import wait_until

from ds_base.processes import python_environment
from ds_base.progress import lines_to
from ds_driver.closed_loop.simulation import DriveRequest
from ds_driver.closed_loop.worker_process import WorkerProcess
from ds_driver.networks.driver_name import AUTOPILOT
from ds_orchestrator.campaign.engine import DriveSettings
from ds_orchestrator.engines import dask_engine
from ds_orchestrator.engines.cluster import ClusterError, ClusterOptions, TlsFiles, connect, read_cluster
from ds_orchestrator.engines.dask_engine import DaskEngine, running_dask
from ds_road import generate
from ds_sim import SimulatorName
from ds_sim.run_codec import encode_run
from ds_sim.scenario import Scenario

QUICK, SLOW = (SimulatorName(f"tests.engines.quick_simulator:{name}") for name in ("QuickSimulator", "SlowSimulator"))
SETTINGS = DriveSettings(siblings=(QUICK,), driver=AUTOPILOT, command_timeout=20.0)
ROADS = [generate(np.random.default_rng(seed), max_angle=150) for seed in range(3)]
OWNER = "DS_TEST_CLUSTER"
"""Variable that marks the processes of a cluster as its own; other tests drive beside them."""


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


class DaskProcesses:
    """Scheduler and workers on loopback."""

    def __init__(self, folder: Path, tls: Sequence[str] = ()) -> None:
        self._folder, self._tls = folder, list(tls)
        self._processes: list[subprocess.Popen[bytes]] = []
        self.port = free_port()
        self.address = f"{'tls' if tls else 'tcp'}://127.0.0.1:{self.port}"
        self.start_scheduler()

    def start_scheduler(self) -> None:
        self.scheduler = self._start("scheduler", "--host", "127.0.0.1", "--port", str(self.port), "--no-dashboard")

    def worker(self, *arguments: str) -> subprocess.Popen[bytes]:
        """Start a worker, without a nanny, so that killing it ends it."""
        name = f"worker_{len(self._processes)}"
        options = ["--host", "127.0.0.1", "--nthreads", "1", "--no-nanny", "--no-dashboard", "--local-directory"]
        return self._start("worker", self.address, *options, str(self._folder / name), *arguments)

    def _start(self, kind: str, *arguments: str) -> subprocess.Popen[bytes]:
        log = self._folder / f"{kind}_{len(self._processes)}.log"
        with log.open("wb") as file:
            process = subprocess.Popen(
                [sys.executable, "-m", "dask", kind, *arguments, *self._tls],
                stdout=file,
                stderr=subprocess.STDOUT,
                env=python_environment() | {OWNER: str(self._folder)},
            )
        self._processes.append(process)
        return process

    def drive_workers(self) -> set[int]:
        """Process ids of what drives for this cluster; other tests' processes drive on the same machine."""
        mine = f"{OWNER}={self._folder}".encode()
        found = set()
        for process in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):  # it ended meanwhile
                drives = b"ds_driver.closed_loop.worker_process" in (process / "cmdline").read_bytes()
                if drives and mine in (process / "environ").read_bytes().split(b"\0"):
                    found.add(int(process.name))
        return found

    def close(self) -> None:
        for process in reversed(self._processes):
            process.send_signal(signal.SIGCONT)
            process.kill()
            process.wait()


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[DaskProcesses]:
    processes = DaskProcesses(tmp_path)
    yield processes
    processes.close()


class Lines(list[str]):
    """Lines that the engine says."""

    def __contains__(self, part: object) -> bool:
        return any(str(part) in line for line in self)


def request(simulator: SimulatorName, seed: int) -> DriveRequest:
    return DriveRequest(Scenario(ROADS[seed % 3], seed=seed), AUTOPILOT, simulator)


@contextmanager
def running(cluster: DaskProcesses, folder: Path) -> Iterator[tuple[DaskEngine, Lines]]:
    settings, lines = replace(SETTINGS, siblings=(SLOW,), cluster=ClusterOptions(scheduler=cluster.address)), Lines()
    with lines_to(lines.append), running_dask(settings, folder=folder) as engine:
        yield engine, lines


def expected(folder: Path, count: int) -> list[bytes]:
    """The runs of one worker process of this machine; the slow simulator gives the numbers of the quick one."""
    process = WorkerProcess(AUTOPILOT, command_timeout=20.0, log=folder / "here.log")
    try:
        with ThreadPoolExecutor(8) as pool:
            runs = pool.map(lambda seed: process.drive(request(QUICK, seed)), range(count))
            return [encode_run(run) for run in runs]
    finally:
        process.close()


class Drives:
    """Drives in the background, at most 16 at a time."""

    def __init__(self, engine: DaskEngine, simulator: SimulatorName, count: int) -> None:
        self._pool = ThreadPoolExecutor(16)
        requests = (request(simulator, seed) for seed in range(count))
        self._futures = [self._pool.submit(engine.drive, one) for one in requests]

    @property
    def done(self) -> int:
        return sum(future.done() for future in self._futures)

    def encoded(self) -> list[bytes]:
        runs = [future.result() for future in self._futures]
        self._pool.shutdown()
        assert not [run.message for run in runs if run.outcome.is_error]
        return [encode_run(run) for run in runs]


def test_workers_join_die_and_differ_and_the_bytes_stay(cluster: DaskProcesses, tmp_path: Path) -> None:
    reference = expected(tmp_path, 32)
    other = tmp_path / "other_version.py"
    other.write_text(
        "from ds_orchestrator.engines import fingerprint\n"
        "from ds_base.installation import versions\n"
        "fingerprint.versions = lambda: versions() | {'numpy': '1.0.0'}\n"
    )
    first = cluster.worker()
    with running(cluster, tmp_path) as (engine, lines):
        drives = Drives(engine, SLOW, 32)
        wait_until(lambda: drives.done > 0)
        late = cluster.worker()
        cluster.worker("--preload", str(other))
        wait_until(lambda: "numpy 1.0.0 there" in lines)
        wait_until(lambda: len(engine.ready) == 2)
        first.kill()
        wait_until(lambda: "is gone: others take over" in lines)
        assert drives.encoded() == reference
        assert len(engine.ready) == 1 and late.poll() is None
    assert len([line for line in lines if "refused" in line]) == 1
    assert cluster.drive_workers()  # of the late worker
    cluster.close()
    wait_until(lambda: not cluster.drive_workers(), 20.0)


@pytest.mark.long
def test_a_scheduler_that_is_restarted_loses_nothing(cluster: DaskProcesses, tmp_path: Path) -> None:
    cluster.worker()
    with running(cluster, tmp_path) as (engine, lines):
        drives = Drives(engine, SLOW, 24)
        wait_until(lambda: drives.done > 2)
        cluster.scheduler.kill()
        wait_until(lambda: "does not answer: waiting" in lines)
        cluster.start_scheduler()
        cluster.worker()
        assert drives.encoded() == expected(tmp_path, 24)
    assert "is back" in lines


@pytest.mark.long
def test_a_worker_that_hangs_is_given_up(
    cluster: DaskProcesses, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dask_engine, "SILENCE", 5.0)
    first = cluster.worker()
    with running(cluster, tmp_path) as (engine, lines):
        drives = Drives(engine, SLOW, 24)
        wait_until(lambda: drives.done > 0)
        first.send_signal(signal.SIGSTOP)
        cluster.worker()
        assert drives.encoded() == expected(tmp_path, 24)
    assert "has been silent for 5 s" in lines


@pytest.mark.long
def test_a_worker_without_the_package_is_refused_by_name(cluster: DaskProcesses, tmp_path: Path) -> None:
    hidden = tmp_path / "hide.py"
    hidden.write_text("import sys\nsys.modules['ds_driver.closed_loop.worker_process'] = None\n")
    cluster.worker("--preload", str(hidden))
    problem = "cannot prepare itself.*is Digital Siblings installed"
    with pytest.raises(ClusterError, match=problem), running(cluster, tmp_path):
        pass


@pytest.mark.long
@pytest.mark.parametrize("count", [1, 2, 4])
def test_an_own_cluster_of_any_size_gives_the_same_bytes(tmp_path: Path, count: int) -> None:
    with running_dask(replace(SETTINGS, workers=count), folder=tmp_path / "own") as engine:
        assert Drives(engine, QUICK, 60).encoded() == expected(tmp_path, 60)


def certificate(folder: Path, name: str) -> tuple[Path, Path]:
    cert, key = folder / f"{name}.pem", folder / f"{name}.key"
    words = f"openssl req -x509 -newkey rsa:2048 -nodes -days 2 -subj /CN={name} -keyout".split()
    subprocess.run([*words, key, "-out", cert], check=True, capture_output=True)
    return cert, key


@pytest.mark.long
def test_tls_by_files_and_a_certificate_of_somebody_else(tmp_path: Path) -> None:
    cert, key = certificate(tmp_path, "ours")
    wrong, wrong_key = certificate(tmp_path, "theirs")
    files = ["--tls-ca-file", str(cert), "--tls-cert", str(cert), "--tls-key", str(key)]
    cluster = DaskProcesses(tmp_path, files)
    try:
        cluster.worker()
        file = tmp_path / "cluster.yaml"
        file.write_text(f"scheduler: {cluster.address}\ntls: {{ca: {cert}, cert: {cert}, key: {key}}}\n")
        with running_dask(replace(SETTINGS, cluster=read_cluster(file)), folder=tmp_path) as engine:
            assert len(Drives(engine, QUICK, 5).encoded()) == 5
        other = ClusterOptions(scheduler=cluster.address, tls=TlsFiles(ca=wrong, cert=wrong, key=wrong_key))
        refused = pytest.raises(ClusterError, match="refuses this TLS connection")
        with refused, running_dask(replace(SETTINGS, cluster=other), folder=tmp_path):
            pass
    finally:
        cluster.close()


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "nothing there, expected keys with values"),
        ("planner: tcp://127.0.0.1:8786", "planner: there is no such key (keys: scheduler, listen, tls, unencryp"),
        ("scheduler: localhost:8786", "expected tls://HOST:PORT or tcp://HOST:PORT"),
        ("scheduler: tcp://10.0.0.5:8786", "neither encrypted nor on this machine"),
        ("scheduler: tls://10.0.0.5:8786", "needs the files of tls"),
        ("listen: 0.0.0.0", "lets anybody on that network run code"),
        ("tls: {ca: ca.pem}", "expected a file that exists; tls.cert: field required"),
        ("tls: {ca: *key}", "not YAML: line 1"),
    ],
)
def test_a_cluster_that_makes_no_sense_is_refused_in_one_line(text: str, problem: str, tmp_path: Path) -> None:
    (tmp_path / "cluster.yaml").write_text(text)
    with pytest.raises(ClusterError) as error:
        read_cluster(tmp_path / "cluster.yaml").check()
    assert problem.lower() in str(error.value).lower() and "\n" not in str(error.value)


def test_no_scheduler_is_one_line() -> None:
    with pytest.raises(ClusterError, match=r"no scheduler answers at tcp://127.0.0.1:9 within 1 s"):
        connect("tcp://127.0.0.1:9", ClusterOptions(), limit=1.0)
