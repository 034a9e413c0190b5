# SPDX-License-Identifier: Apache-2.0
"""Engine `dask`: the same worker processes on any number of machines, behind a Dask scheduler.

A task is a batch of drives, pinned to one worker. Which worker takes which batch, and how often a batch is handed out
because a worker died, changes no byte of a result: a drive depends on its simulator, driver, road, seed and conditions
alone, and only the first answer to it counts.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ds_base.errors import RunError
from ds_base.progress import logger_of
from ds_driver.closed_loop.drive_request import DriveRequest, request_to_json
from ds_orchestrator.campaign.engine import DriveSettings, Watch
from ds_orchestrator.engines import dask_worker
from ds_orchestrator.engines.cluster import ClusterOptions, connect, own_cluster
from ds_orchestrator.engines.local import DRIVES_PER_WORKER
from ds_orchestrator.engines.membership import Membership, RemoteWorker
from ds_orchestrator.engines.parcel import Parcel, parcel_of
from ds_sim.run_codec import RunCodecError, decode_run
from ds_sim.session import RunRecord
from ds_sim.simulator import Outcome

LOG = logger_of(__name__)

MOST_THREADS = 256
"""Drives that a campaign has ready at a time, each with a waiting thread; chosen: 64 cores with a batch of four."""
ANSWER_TIME = 60.0
"""Limit for the transfer of a batch's runs, s."""
LOSSES = 5
"""Workers that one drive may lose; chosen: further ones are taken to be the drive's own fault."""


class EngineError(RunError):
    """The cluster cannot drive any more; what was finished is kept."""


@dataclass(eq=False)
class _Job:
    """One drive."""

    request: DriveRequest
    losses: int = 0
    answer: Future[RunRecord] = field(default_factory=Future)

    def end(self, outcome: Outcome, message: str) -> None:
        if not self.answer.done():
            self.answer.set_result(self.request.ended(outcome, message))


@dataclass(eq=False)
class _Batch:
    """Drives that one worker has."""

    jobs: list[_Job]
    task: Any = None


@dataclass(eq=False)
class _Seat:
    """A worker and its batches."""

    worker: RemoteWorker
    batches: list[_Batch] = field(default_factory=list)

    @property
    def free(self) -> int:
        return self.worker.threads - len(self.batches)


class DaskEngine:
    """Drives on a cluster; satisfies `membership.Members`, too.

    Args:
        address: address of the scheduler.
        options: how to connect to it again.
        client: connected `distributed.Client`.
        parcel: driver and simulators.
        command_timeout: wall-clock time for one answer of the driver, s.
    """

    def __init__(
        self,
        address: str,
        options: ClusterOptions,
        client: Any,
        parcel: Parcel,
        *,
        command_timeout: float,
    ) -> None:
        self._sha256, self._timeout = parcel.sha256, command_timeout
        self._changed = threading.Condition()
        self._pending: deque[_Job] = deque()
        self._seats: dict[str, _Seat] = {}
        self._stopped, self._failure, self._tasks = False, "", 0
        self._membership = Membership(address, options, client, parcel, command_timeout=command_timeout, members=self)
        self._thread = threading.Thread(target=self._hand_out, name="batches", daemon=True)
        self._thread.start()

    @property
    def capacity(self) -> int | None:
        """Drives at a time; more than most clusters take, as workers may join."""
        return MOST_THREADS

    @property
    def workers(self) -> list[str]:
        """Addresses of the workers that drive."""
        with self._changed:
            return list(self._seats)

    def wait_for_worker(self) -> None:
        """Wait until a worker is ready; see `Membership.wait_for_worker`."""
        self._membership.wait_for_worker()

    def drive(self, request: DriveRequest, watch: Watch | None = None) -> RunRecord:
        """Drive a road on some worker; waits for one that is free, and gives no feedback.

        Raises:
            EngineError: the scheduler or all workers are gone for too long.
        """
        job = _Job(request)
        with self._changed:
            if self._failure:
                raise EngineError(self._failure)
            if self._stopped:
                job.end(Outcome.CANCELLED, "stopped")
            else:
                self._pending.append(job)
                self._changed.notify_all()
        return job.answer.result()

    def stop(self) -> None:
        """End every drive now, as CANCELLED."""
        jobs, tasks = self._drop_everything()
        for job in jobs:
            job.end(Outcome.CANCELLED, "stopped")
        self._cancel(tasks)

    def close(self) -> None:
        """Stop, and leave the cluster."""
        self.stop()
        self._thread.join(ANSWER_TIME)
        self._membership.close()
        with suppress(Exception):
            self._membership.client.close(timeout=2.0)

    def worker_ready(self, worker: RemoteWorker) -> None:
        """See `Members.worker_ready`."""
        with self._changed:
            if not self._stopped:
                self._seats[worker.address] = _Seat(worker)
                self._changed.notify_all()

    def worker_lost(self, address: str) -> None:
        """See `Members.worker_lost`."""
        with self._changed:
            seat = self._seats.pop(address, None)
            batches = [] if seat is None else list(seat.batches)
        for batch in reversed(batches):
            assert seat is not None
            self._queue_again(seat, batch)
        self._cancel([batch.task for batch in batches if batch.task is not None])

    def cluster_lost(self, reason: str) -> None:
        """See `Members.cluster_lost`."""
        self._failure = reason
        for job in self._drop_everything()[0]:
            if not job.answer.done():
                job.answer.set_exception(EngineError(reason))

    def _drop_everything(self) -> tuple[list[_Job], list[Any]]:
        """Hand out nothing any more; return the open drives and tasks."""
        with self._changed:
            self._stopped = True
            batches = [batch for seat in self._seats.values() for batch in seat.batches]
            jobs = [*self._pending, *(job for batch in batches for job in batch.jobs)]
            self._pending.clear()
            self._seats.clear()
            self._changed.notify_all()
        return jobs, [batch.task for batch in batches if batch.task is not None]

    def _cancel(self, tasks: list[Any]) -> None:
        if tasks:
            with suppress(Exception):  # the scheduler may be gone
                self._membership.client.cancel(tasks, force=True)

    def _hand_out(self) -> None:
        while True:
            with self._changed:
                while not self._stopped and not (self._pending and any(s.free > 0 for s in self._seats.values())):
                    self._changed.wait()
                if self._stopped:
                    return
                seat = max(self._seats.values(), key=lambda s: s.free / s.worker.threads)
                # While there are few drives, every free thread gets some, instead of one thread all.
                share = math.ceil(len(self._pending) / sum(s.free for s in self._seats.values()))
                size = min(share, seat.worker.largest_batch, DRIVES_PER_WORKER)
                batch = _Batch([self._pending.popleft() for _ in range(size)])
                seat.batches.append(batch)
                self._tasks += 1
                name = f"digital-siblings-{self._sha256[:8]}-{id(self):x}-{self._tasks}"
            try:
                batch.task = self._membership.client.submit(
                    dask_worker.drive,
                    self._sha256,
                    self._timeout,
                    [request_to_json(job.request) for job in batch.jobs],
                    key=name,
                    workers=[seat.worker.address],
                    allow_other_workers=False,
                    pure=False,
                    retries=0,
                )
                batch.task.add_done_callback(lambda task, batch=batch, seat=seat: self._receive(seat, batch, task))
            except Exception:  # the client is closing, and the membership finds out why
                self._membership.forget(seat.worker.address)

    def _receive(self, seat: _Seat, batch: _Batch, task: Any) -> None:
        """Hand over the runs of a finished task; of a batch that was handed out again, the later answer is dropped."""
        try:
            answers = task.result(timeout=ANSWER_TIME)
        except BaseException as error:  # cancelled or lost too
            self._queue_again(seat, batch, " ".join(f"{type(error).__name__}: {error}".split())[:200])
            return
        finally:
            with suppress(Exception):
                task.release()
        try:
            if answers is None:
                raise RunCodecError("the worker was restarted under its address")
            runs = [decode_run(answer, job.request.scenario) for answer, job in zip(answers, batch.jobs, strict=True)]
        except ValueError as error:
            self._queue_again(seat, batch, str(error))
            self._membership.forget(seat.worker.address)  # it prepares itself again
            return
        with self._changed:
            if batch not in seat.batches:
                return
            seat.batches.remove(batch)
            self._changed.notify_all()
        for job, run in zip(batch.jobs, runs, strict=True):
            if not job.answer.done():
                job.answer.set_result(run)

    def _queue_again(self, seat: _Seat, batch: _Batch, why: str = "") -> None:
        """Queue the drives of a batch before all others, unless that has been done."""
        with self._changed:
            if batch not in seat.batches or self._stopped:
                return
            seat.batches.remove(batch)
            for job in reversed(batch.jobs):
                job.losses += 1
                if job.losses < LOSSES:
                    self._pending.appendleft(job)
                else:
                    job.end(Outcome.SIM_ERROR, f"{LOSSES} workers were lost while they drove it {why}".rstrip())
            self._changed.notify_all()


@contextmanager
def running_dask(settings: DriveSettings, *, folder: Path) -> Iterator[DaskEngine]:
    """Connect to the cluster, or start one on this machine; yield an engine, and leave the cluster.

    Args:
        settings: driver, simulators, the cluster, and the number of workers of an own one.
        folder: folder for an own cluster's files, created if missing.

    Raises:
        ds_orchestrator.engines.cluster.ClusterError: there is no scheduler, or no usable worker.
        ValueError: the driver cannot be sent.
    """
    options = settings.cluster
    options.check()
    parcel = parcel_of(settings.driver, settings.simulators)
    with ExitStack() as stack:
        address = options.scheduler
        if address is None:
            folder.mkdir(parents=True, exist_ok=True)
            address = stack.enter_context(own_cluster(settings.workers, options, folder))
            if options.listen != ClusterOptions().listen:
                LOG.info("further workers may join: dask worker %s", address)
        client = connect(address, options)
        engine = DaskEngine(address, options, client, parcel, command_timeout=settings.command_timeout)
        stack.callback(engine.close)
        engine.wait_for_worker()
        yield engine
