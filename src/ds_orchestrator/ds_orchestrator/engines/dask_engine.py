"""Engine `dask`: the same worker processes on any number of machines, behind a Dask scheduler.

A task is a batch of drives, pinned to one worker. Which worker takes which batch, and how often a batch is handed out
because a worker died, changes no byte of a result: a drive depends on its simulator, driver, road and seed alone, and
only the first answer to it counts.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ds_orchestrator.engines import dask_worker
from ds_orchestrator.engines.cluster import ClusterError, ClusterOptions, connect, own_cluster
from ds_orchestrator.engines.fingerprint import differences, fingerprint
from ds_orchestrator.engines.local import DRIVES_PER_WORKER
from ds_orchestrator.engines.parcel import Parcel, parcel_of
from ds_road import Road
from ds_road.files import road_to_json
from ds_sim.run_codec import RunCodecError, decode_run
from ds_sim.session import RunRecord
from ds_sim.simulator import Outcome

MOST_THREADS = 256
"""Drives that a campaign has ready at a time, each with a waiting thread; chosen: 64 cores with a batch of four."""
FIRST_WORKER_TIME = 180.0
"""Limit for the first worker to appear and prepare itself, s; more than `PREPARE_TIME`, so that its reason is known."""
NO_WORKER_TIME = 600.0
"""Limit for a worker to come back after the last one was lost, s; chosen: a cluster's queue may have to start one."""
SCHEDULER_TIME = 300.0
"""Limit for a lost scheduler to come back, s; chosen: the restart of a machine."""
PREPARE_TIME = 120.0
"""Limit for a worker to prepare itself, s: imports, files and driver, on a busy machine."""
SILENCE = 30.0
"""Time without a heartbeat after which a worker is given up, s; Dask's workers send one every second."""
CONTACT_TIME = 5.0
"""Limit for one answer of the scheduler, s."""
ANSWER_TIME = 60.0
"""Limit for the transfer of a batch's runs, s."""
LOSSES = 5
"""Workers that one drive may lose; chosen: further ones are taken to be the drive's own fault."""
_LOOK = 0.5
"""Seconds between two looks at the scheduler."""


class EngineError(RuntimeError):
    """The cluster cannot drive any more; what was finished is kept."""


@dataclass(eq=False)
class _Job:
    """One drive."""

    simulator: str
    road: Road
    seed: int
    losses: int = 0
    answer: Future[RunRecord] = field(default_factory=Future)

    def request(self) -> dict[str, Any]:
        return {"simulator": self.simulator, "road": road_to_json(self.road), "seed": self.seed}

    def end(self, outcome: Outcome, message: str) -> None:
        record = RunRecord(road=self.road, seed=self.seed, outcome=outcome, message=message)
        if not self.answer.done():
            self.answer.set_result(record)


@dataclass(eq=False)
class _Worker:
    """One worker that has the parcel."""

    address: str
    threads: int
    largest_batch: int
    batches: list[_Batch] = field(default_factory=list)


@dataclass(eq=False)
class _Batch:
    """Drives that one worker has."""

    jobs: list[_Job]
    task: Any = None


class DaskExecutor:
    """Drives on a cluster; satisfies `ds_orchestrator.campaign.runner.Executor`.

    Args:
        address: address of the scheduler.
        options: how to connect to it again.
        client: connected `distributed.Client`.
        parcel: driver and simulators.
        command_timeout: wall-clock time for one answer of the driver, s.
        say: called with one line when a worker is refused or lost, or the scheduler is.
    """

    capacity: int | None = MOST_THREADS

    def __init__(
        self,
        address: str,
        options: ClusterOptions,
        client: Any,
        parcel: Parcel,
        *,
        command_timeout: float,
        say: Callable[[str], None],
    ) -> None:
        self._address, self._options, self._client = address, options, client
        self._parcel, self._sha256, self._timeout, self._say = parcel, parcel.sha256, command_timeout, say
        self._here = fingerprint(parcel.backend)
        self._changed = threading.Condition()
        self._pending: deque[_Job] = deque()
        self._workers: dict[str, _Worker] = {}
        self._known: set[str] = set()
        self._heard: dict[str, tuple[float, float]] = {}
        self._refusals: dict[str, str] = {}
        self._stopped, self._failure = False, ""
        self._tasks = 0
        self._threads = [
            threading.Thread(target=work, name=work.__name__.strip("_"), daemon=True)
            for work in (self._watch, self._hand_out)
        ]
        for thread in self._threads:
            thread.start()

    def execute(self, simulator: str, road: Road, seed: int) -> RunRecord:
        """Drive a road on some worker; waits for one that is free.

        Raises:
            EngineError: the scheduler or all workers are gone for too long.
        """
        job = _Job(simulator, road, seed)
        with self._changed:
            if self._stopped:
                job.end(Outcome.CANCELLED, "stopped")
            elif self._failure:
                raise EngineError(self._failure)
            else:
                self._pending.append(job)
                self._changed.notify_all()
        return job.answer.result()

    @property
    def workers(self) -> list[str]:
        """Addresses of the workers that drive."""
        with self._changed:
            return list(self._workers)

    def wait_for_worker(self, limit: float = FIRST_WORKER_TIME) -> None:
        """Wait until a worker is ready.

        Raises:
            ClusterError: none is ready within `limit` seconds; names the first worker that was refused.
        """
        deadline = time.monotonic() + limit
        told = False
        with self._changed:
            while not self._workers:
                if self._failure:
                    raise EngineError(self._failure)
                if time.monotonic() > deadline or (self._refusals and self._known <= self._refusals.keys()):
                    why = next(iter(self._refusals.values()), "there is none: start one with `dask worker ADDRESS`")
                    raise ClusterError(f"no usable worker at {self._address}: {why}")
                if not told and not self._known and time.monotonic() > deadline - limit + 3.0:
                    told = True
                    self._say(f"waiting for a worker at {self._address}, {limit:.0f} s at most")
                self._changed.wait(_LOOK)

    def stop(self) -> None:
        """End every drive now, as CANCELLED."""
        with self._changed:
            self._stopped = True
            jobs = [*self._pending, *(j for w in self._workers.values() for b in w.batches for j in b.jobs)]
            tasks = [b.task for w in self._workers.values() for b in w.batches if b.task is not None]
            self._pending.clear()
            self._workers.clear()
            self._changed.notify_all()
        for job in jobs:
            job.end(Outcome.CANCELLED, "stopped")
        with suppress(Exception):
            self._client.cancel(tasks, force=True)

    def close(self) -> None:
        """Stop, and leave the cluster."""
        self.stop()
        for thread in self._threads:
            thread.join(2 * _LOOK + 5.0)
        with suppress(Exception):
            self._client.close(timeout=2.0)

    # Handing out

    def _hand_out(self) -> None:
        while True:
            with self._changed:
                while not self._stopped and not (self._pending and self._free()):
                    self._changed.wait()
                if self._stopped:
                    return
                worker = min(self._free(), key=lambda w: len(w.batches) / w.threads)
                free = sum(w.threads - len(w.batches) for w in self._workers.values())
                # While there are few drives, every free thread gets some, instead of one thread all.
                size = min(worker.largest_batch, math.ceil(len(self._pending) / free))
                batch = _Batch([self._pending.popleft() for _ in range(size)])
                worker.batches.append(batch)
                self._tasks += 1
                name = f"digital-siblings-{self._sha256[:8]}-{id(self):x}-{self._tasks}"
                client = self._client
            try:
                task = client.submit(
                    dask_worker.drive,
                    self._sha256,
                    self._timeout,
                    [job.request() for job in batch.jobs],
                    key=name,
                    workers=[worker.address],
                    allow_other_workers=False,
                    pure=False,
                    retries=0,
                )
                batch.task = task
                task.add_done_callback(lambda task, batch=batch, worker=worker: self._receive(worker, batch, task))
            except Exception:  # the client is closing: `_watch` finds out why
                self._lose(worker, batch)

    def _free(self) -> list[_Worker]:
        return [worker for worker in self._workers.values() if len(worker.batches) < worker.threads]

    def _receive(self, worker: _Worker, batch: _Batch, task: Any) -> None:
        """Hand over the runs of a finished task; of a batch that was handed out again, the later answer is dropped."""
        try:
            answers = task.result(timeout=ANSWER_TIME)
            if answers is None:
                raise LookupError
            runs = [decode_run(a, job.road, job.seed) for a, job in zip(answers, batch.jobs, strict=True)]
        except (LookupError, RunCodecError, ValueError) as error:
            # Restarted under the same address: it prepares itself again.
            self._forget(worker.address, str(error))
            return
        except BaseException as error:
            self._lose(worker, batch, " ".join(f"{type(error).__name__}: {error}".split())[:200])
            return
        finally:
            with suppress(Exception):
                task.release()
        with self._changed:
            if batch not in worker.batches:
                return
            worker.batches.remove(batch)
            self._changed.notify_all()
        for job, run in zip(batch.jobs, runs, strict=True):
            if not job.answer.done():
                job.answer.set_result(run)

    def _lose(self, worker: _Worker, batch: _Batch, why: str = "") -> None:
        """Queue the drives of a batch again, before all others."""
        with self._changed:
            if batch not in worker.batches or self._stopped:
                return
            worker.batches.remove(batch)
            for job in reversed(batch.jobs):
                job.losses += 1
                if job.losses < LOSSES:
                    self._pending.appendleft(job)
                else:
                    job.end(Outcome.SIM_ERROR, f"{LOSSES} workers were lost while they drove it {why}".rstrip())
            self._changed.notify_all()

    def _forget(self, address: str, why: str = "") -> None:
        """Take no account of a worker any more, and queue what it drove."""
        with self._changed:
            worker = self._workers.pop(address, None)
            self._known.discard(address)
            self._heard.pop(address, None)
        if worker is not None:
            for batch in reversed(list(worker.batches)):
                task = batch.task
                self._lose(worker, batch, why)
                if task is not None:
                    with suppress(Exception):
                        self._client.cancel([task], force=True)

    # Watching

    def _watch(self) -> None:
        without_since: float | None = time.monotonic()
        while not self._stopped and not self._failure:
            try:
                identity = self._client.sync(
                    self._client.scheduler.identity, n_workers=-1, callback_timeout=2 * CONTACT_TIME
                )
                present = identity["workers"]
            except Exception:
                self._reconnect()
                without_since = time.monotonic()
                continue
            self._compare(present)
            now = time.monotonic()
            with self._changed:
                lacking = not self._workers
            without_since = (without_since or now) if lacking else None
            if without_since is not None and now - without_since > NO_WORKER_TIME:
                self._fail(f"no worker at {self._address} for {NO_WORKER_TIME:.0f} s: start one, and resume")
            with self._changed:
                self._changed.wait_for(lambda: self._stopped, _LOOK)

    def _compare(self, present: dict[str, Any]) -> None:
        """Prepare new workers, and give up lost or silent ones."""
        now = time.monotonic()
        for address in self._known - present.keys():
            if address in self._workers:
                self._say(f"worker {address} is gone: others take over its drives")
            self._refusals.pop(address, None)
            self._forget(address)
        for address, about in present.items():
            seen = float(about.get("last_seen", 0.0))
            if self._heard.get(address, (None, 0.0))[0] != seen:
                self._heard[address] = (seen, now)
            elif now - self._heard[address][1] > SILENCE and address in self._workers:
                self._say(f"worker {address} has been silent for {SILENCE:.0f} s: others take over its drives")
                heard = self._heard[address]
                self._forget(address)
                self._heard[address] = heard
                continue
            silent = now - self._heard[address][1] > SILENCE
            if address not in self._known and not silent:
                self._known.add(address)
                threading.Thread(target=self._prepare, args=(address, about), daemon=True).start()

    def _prepare(self, address: str, about: dict[str, Any]) -> None:
        """Check that a worker computes the same bits, give it the parcel, and let it drive."""
        try:
            # First by itself: Dask loses the error of a function whose module cannot be imported.
            self._on(address, exec, f"import {dask_worker.__name__}", {})
            found = self._on(address, dask_worker.describe, self._sha256, self._parcel.backend)
            problem = found.get("error") or differences(self._here, found["fingerprint"])
            if problem:
                self._refuse(address, f"worker {address} is refused: {problem}")
                return
            # The files travel once per worker.
            known = "largest_batch" in found
            ready = found if known else self._on(address, dask_worker.prepare, self._parcel, self._timeout)
        except Exception as error:
            if self._stopped or address not in self._known:
                return
            what = " ".join(f"{type(error).__name__}: {error}".split())[:200]
            self._refuse(address, f"worker {address} cannot prepare itself ({what}): is Digital Siblings installed?")
            return
        if "error" in ready:
            self._refuse(address, f"worker {address} is refused: {ready['error']}")
            return
        batch = min(int(ready["largest_batch"]), DRIVES_PER_WORKER)
        with self._changed:
            if address in self._known and not self._stopped:
                self._workers[address] = _Worker(address, int(about["nthreads"]), batch)
                self._changed.notify_all()

    def _refuse(self, address: str, line: str) -> None:
        with self._changed:
            self._refusals[address] = line
            self._changed.notify_all()
        self._say(line)

    def _on(self, address: str, function: Callable[..., Any], *arguments: Any) -> Any:
        task = self._client.submit(
            function, *arguments, workers=[address], allow_other_workers=False, pure=False, retries=0
        )
        try:
            return task.result(timeout=PREPARE_TIME)
        finally:
            with suppress(Exception):
                task.release()

    def _reconnect(self) -> None:
        """Queue all drives, and wait for the scheduler to come back."""
        with self._changed:
            if self._stopped:
                return
            addresses = list(self._workers)
        for address in addresses:
            self._forget(address)
        with self._changed:
            self._known.clear()
            self._heard.clear()
            self._refusals.clear()
        self._say(f"the scheduler at {self._address} does not answer: waiting {SCHEDULER_TIME:.0f} s at most")
        with suppress(Exception):
            self._client.close(timeout=1.0)
        deadline = time.monotonic() + SCHEDULER_TIME
        while not self._stopped:
            try:
                client = connect(self._address, self._options, limit=CONTACT_TIME)
            except ClusterError:
                if time.monotonic() > deadline:
                    self._fail(f"the scheduler at {self._address} did not come back: start it, and resume")
                    return
                with self._changed:
                    self._changed.wait_for(lambda: self._stopped, 1.0)
                continue
            with self._changed:
                self._client = client
                self._changed.notify_all()
            self._say(f"the scheduler at {self._address} is back")
            return

    def _fail(self, reason: str) -> None:
        with self._changed:
            self._failure = reason
            jobs, self._pending = list(self._pending), deque()
            jobs += [j for w in self._workers.values() for b in w.batches for j in b.jobs]
            self._workers.clear()
            self._changed.notify_all()
        for job in jobs:
            if not job.answer.done():
                job.answer.set_exception(EngineError(reason))


@contextmanager
def running_dask(
    driver: str,
    simulators: list[str],
    *,
    workers: int,
    command_timeout: float,
    folder: Path,
    options: ClusterOptions,
    say: Callable[[str], None],
) -> Iterator[DaskExecutor]:
    """Connect to the cluster, or start one on this machine; yield an executor, and leave the cluster.

    Args:
        driver: as in `ds_driver.closed_loop.simulation.Drive`.
        simulators: names of the simulators.
        workers: number of workers of an own cluster.
        command_timeout: wall-clock time for one answer of the driver, s.
        folder: folder for an own cluster's files, created if missing.
        options: which cluster.
        say: called with one line when a worker is refused or lost, or the scheduler is.

    Raises:
        ClusterError: there is no scheduler, or no usable worker.
        ValueError: the driver cannot be sent.
    """
    options.check()
    parcel = parcel_of(driver, simulators)
    with ExitStack() as stack:
        address = options.scheduler
        if address is None:
            folder.mkdir(parents=True, exist_ok=True)
            address = stack.enter_context(own_cluster(workers, options, folder))
            if options.listen != ClusterOptions.listen:
                say(f"further workers may join: dask worker {address}")
        client = connect(address, options)
        executor = DaskExecutor(address, options, client, parcel, command_timeout=command_timeout, say=say)
        stack.callback(executor.close)
        executor.wait_for_worker()
        yield executor
