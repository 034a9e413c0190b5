# SPDX-License-Identifier: Apache-2.0
"""Engine `dask`: the engine `local` on any number of machines, behind a Dask scheduler.

A task is one drive, pinned to one worker. Which worker takes it, and how often it is handed out because one died,
changes no byte: a drive depends on simulator, driver, road, seed and conditions alone, and its first answer counts.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Future, InvalidStateError
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ds_base.errors import RunError
from ds_base.folder_files import enter_folder
from ds_base.processes import RunningClock, check_semaphores
from ds_base.progress import logger_of
from ds_driver.closed_loop.simulation import DriveRequest, request_to_json
from ds_orchestrator.campaign.engine import DriveSettings, Watch
from ds_orchestrator.engines import dask_worker
from ds_orchestrator.engines.cluster import ClusterError, ClusterOptions, connect, own_cluster
from ds_orchestrator.engines.fingerprint import differences, fingerprint
from ds_sim.run_codec import decode_run
from ds_sim.session import RunRecord
from ds_sim.simulator import Outcome

LOG = logger_of(__name__)

MOST_THREADS = 256
"""Drives that a campaign has ready at a time, each with a waiting thread; chosen: 64 cores with four drives each."""
LOSSES = 5
"""Workers that one drive may lose; chosen: further ones are taken to be the drive's own fault."""
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
CONTACT_TIME = 10.0
"""Limit for one answer of the scheduler, s."""
ANSWER_TIME = 60.0
"""Limit for the transfer of a result, s."""
_LOOK = 0.5
"""Seconds between two looks at the scheduler."""


@dataclass(eq=False)
class RemoteWorker:
    """Worker of the cluster."""

    address: str
    room: int = 0  # drives that it takes at a time; 0 until it is prepared
    drives: set[Future[Any]] = field(default_factory=set)  # results that it owes
    refusal: str = ""  # why it may not drive, one line, or ""


class DaskEngine:
    """Drives on the workers of a cluster: prepares those that join, and gives up those that are lost."""

    def __init__(
        self, address: str, options: ClusterOptions, parcel: dask_worker.Parcel, *, command_timeout: float
    ) -> None:
        self._address, self._options, self._parcel = address, options, parcel
        self._key = parcel.sha256, command_timeout
        self._client = connect(address, options)
        self._here = fingerprint(parcel.backend, parcel.simulators)
        self._changed = threading.Condition()
        self._workers: dict[str, RemoteWorker] = {}
        self._heartbeats: dict[str, tuple[float, float]] = {}
        """Address -> time of the last heartbeat by the scheduler's clock, and when this process saw it change."""
        self._clock = RunningClock()
        self._stopped, self._failure = False, ""
        self._thread = threading.Thread(target=self._watch, name="dask engine", daemon=True)
        self._thread.start()

    @property
    def ready(self) -> list[str]:
        """Addresses of the workers that drive."""
        with self._changed:
            return [worker.address for worker in self._workers.values() if worker.room]

    def wait_for_worker(self) -> None:
        """Wait until a worker is ready, `FIRST_WORKER_TIME` at most; or ClusterError with why the first was refused."""
        began, announced = time.monotonic(), False
        with self._changed:
            while not any(worker.room for worker in self._workers.values()):
                waited = time.monotonic() - began
                if self._failure:
                    raise ClusterError(self._failure)
                refusals = [worker.refusal for worker in self._workers.values()]
                if waited > FIRST_WORKER_TIME or (refusals and all(refusals)):
                    why = next(filter(None, refusals), "there is none: start one with `dask worker ADDRESS`")
                    raise ClusterError(f"no usable worker at {self._address}: {why}")
                if not announced and not self._workers and waited > 3.0:
                    announced = True
                    LOG.info("waiting for a worker at %s, %.0f s at most", self._address, FIRST_WORKER_TIME)
                self._changed.wait(_LOOK)

    @property
    def capacity(self) -> int | None:
        """Drives at a time; more than most clusters take, as workers may join."""
        return MOST_THREADS

    def drive(self, request: DriveRequest, watch: Watch | None = None) -> RunRecord:
        """Drive a road on some worker; waits for one that is free, and gives no feedback.

        An error costs the worker, which is prepared again if it is still there.

        Raises:
            RunError: the scheduler or all workers are gone for too long.
        """
        lost = ""
        for _ in range(LOSSES):
            answer: Future[Any] = Future()
            with self._changed:
                self._changed.wait_for(lambda: self._stopped or self._failure or self._free())
                if self._failure:
                    raise RunError(self._failure)
                if self._stopped:
                    return request.ended(Outcome.CANCELLED, "stopped")
                worker = min(self._free(), key=lambda one: len(one.drives) / one.room)
                worker.drives.add(answer)
            try:
                return self._drive_on(worker, answer, request)
            except Exception as error:
                self._forget(worker)
                lost = "" if isinstance(error, CancelledError) else _one_line(error)
            finally:
                with self._changed:
                    worker.drives.discard(answer)
                    self._changed.notify_all()
        return request.ended(Outcome.SIM_ERROR, f"{LOSSES} workers were lost while they drove it {lost}".rstrip())

    def _drive_on(self, worker: RemoteWorker, answer: Future[Any], request: DriveRequest) -> RunRecord:
        """Drive on one worker; `answer` gets the result, unless the worker is given up before."""
        task = self._submit(worker.address, dask_worker.drive, self._key, request_to_json(request))
        task.add_done_callback(lambda task: _hand_over(task, answer))
        try:
            encoded = answer.result()
        finally:
            with suppress(Exception):  # the scheduler may be gone
                if not task.done():
                    task.cancel(force=True)
        if encoded is None:
            raise ValueError("the worker was restarted under its address")
        return decode_run(encoded, request.scenario)

    def stop(self) -> None:
        """End every drive now, as CANCELLED, and watch the cluster no more."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()
        self._forget(*self._workers.values())

    def close(self) -> None:
        """Stop, and disconnect."""
        self.stop()
        self._thread.join(CONTACT_TIME + _LOOK)
        with suppress(Exception):
            self._client.close(timeout=2.0)

    def _free(self) -> list[RemoteWorker]:
        return [worker for worker in self._workers.values() if len(worker.drives) < worker.room]

    def _forget(self, *workers: RemoteWorker) -> None:
        """Take no account of workers any more; those that are still there are prepared again."""
        with self._changed:
            for worker in workers:
                if self._workers.get(worker.address) is worker:
                    del self._workers[worker.address]
                worker.room = 0
            answers = [answer for worker in workers for answer in worker.drives]
        for answer in answers:
            answer.cancel()

    def _submit(self, address: str, function: Callable[..., Any], *arguments: Any) -> Any:
        return self._client.submit(
            function, *arguments, workers=[address], allow_other_workers=False, pure=False, retries=0
        )

    def _watch(self) -> None:
        without_since = time.monotonic()
        while not self._stopped:
            try:
                identity = self._client.scheduler.identity
                present = self._client.sync(identity, n_workers=-1, callback_timeout=CONTACT_TIME)["workers"]
            except Exception:  # whatever the library raises, there was no answer
                self._reconnect()
                without_since = time.monotonic()
                continue
            self._compare(present)
            if self.ready:
                without_since = time.monotonic()
            elif time.monotonic() - without_since > NO_WORKER_TIME:
                self._fail(f"no worker at {self._address} for {NO_WORKER_TIME:.0f} s: start one, and resume")
            self._pause(_LOOK)

    def _compare(self, present: dict[str, Any]) -> None:
        """Prepare new workers, and give up lost and silent ones."""
        now = self._clock.now()
        with self._changed:
            workers = dict(self._workers)
        for address in workers.keys() - present.keys():
            if workers[address].room:
                LOG.warning("worker %s is gone: others take over its drives", address)
            self._heartbeats.pop(address, None)
            self._forget(workers[address])
        for address, about in present.items():
            beat = float(about.get("last_seen", 0.0))
            if self._heartbeats.get(address, (None, 0.0))[0] != beat:
                self._heartbeats[address] = (beat, now)
            silent = now - self._heartbeats[address][1] > SILENCE
            if silent and address in workers and workers[address].room:
                LOG.warning("worker %s has been silent for %.0f s: others take over its drives", address, SILENCE)
                self._forget(workers[address])
            elif not silent and address not in workers:
                worker = RemoteWorker(address)
                with self._changed:
                    self._workers[address] = worker
                threading.Thread(target=self._prepare, args=(worker,), daemon=True).start()

    def _prepare(self, worker: RemoteWorker) -> None:
        """Check that a worker computes the same bits, give it the parcel, and let it drive."""

        def run(function: Callable[..., Any], *arguments: Any) -> Any:
            return self._submit(worker.address, function, *arguments).result(PREPARE_TIME)

        room = 0
        try:
            # First by itself: Dask loses the error of a function whose module cannot be imported.
            run(exec, f"import {dask_worker.__name__}", {})
            there, room = run(dask_worker.describe_worker, self._key, self._parcel.backend, self._parcel.simulators)
            if refusal := differences(self._here, there):
                refusal = f"is refused: {refusal}"
            elif not room:  # the files travel once per worker
                room = run(dask_worker.unpack_parcel, self._key, self._parcel)
        except Exception as error:  # a task on another machine may raise anything
            question = ": is Digital Siblings installed there?" if isinstance(error, ImportError) else ""
            refusal = f"cannot prepare itself ({_one_line(error)}){question}"
        with self._changed:
            if self._stopped or self._workers.get(worker.address) is not worker:
                return
            worker.refusal = refusal and f"worker {worker.address} {refusal}"
            worker.room = 0 if refusal else room
            self._changed.notify_all()
        if refusal:
            LOG.warning(worker.refusal)

    def _reconnect(self) -> None:
        """Give up all workers, and wait for the scheduler to come back."""
        if self._stopped:
            return
        self._forget(*self._workers.values())
        self._heartbeats.clear()
        LOG.warning("the scheduler at %s does not answer: waiting %.0f s at most", self._address, SCHEDULER_TIME)
        with suppress(Exception):
            self._client.close(timeout=1.0)
        deadline = time.monotonic() + SCHEDULER_TIME
        while not self._stopped:
            try:
                self._client = connect(self._address, self._options, limit=CONTACT_TIME / 2)
                LOG.info("the scheduler at %s is back", self._address)
                return
            except ClusterError:
                if time.monotonic() > deadline:
                    self._fail(f"the scheduler at {self._address} did not come back: start it, and resume")
            self._pause(1.0)

    def _fail(self, reason: str) -> None:
        self._failure = reason
        self.stop()

    def _pause(self, seconds: float) -> None:
        with self._changed:
            self._changed.wait_for(lambda: self._stopped, seconds)


def _hand_over(task: Any, answer: Future[Any]) -> None:
    """Fetch the result of a finished task; if its worker was given up, the result is dropped."""
    with suppress(InvalidStateError):
        try:
            answer.set_result(task.result(timeout=ANSWER_TIME))
        except Exception as error:  # a task on another machine may raise anything
            answer.set_exception(error)


def _one_line(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())[:200]


@contextmanager
def running_dask(settings: DriveSettings, *, folder: Path) -> Iterator[DaskEngine]:
    """Connect to the cluster, or start one, with files in a folder; yield an engine, and leave the cluster.

    ClusterError if there is no scheduler, or no usable worker.
    """
    options = settings.cluster
    options.check()
    parcel = dask_worker.parcel_of(settings.driver, settings.simulators)
    with ExitStack() as stack:
        address = options.scheduler
        if address is None:
            check_semaphores()
            enter_folder(folder)
            address = stack.enter_context(own_cluster(settings.workers, options, folder))
            if options.listen != ClusterOptions().listen:
                LOG.info("further workers may join: dask worker %s", address)
        engine = DaskEngine(address, options, parcel, command_timeout=settings.command_timeout)
        stack.callback(engine.close)
        engine.wait_for_worker()
        yield engine
