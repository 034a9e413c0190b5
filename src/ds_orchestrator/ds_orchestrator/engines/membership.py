# SPDX-License-Identifier: Apache-2.0
"""Keeps track of a cluster's scheduler and workers: who may drive, who is lost, who is refused."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol

from ds_base.progress import logger_of
from ds_orchestrator.engines import dask_worker
from ds_orchestrator.engines.cluster import ClusterError, ClusterOptions, connect
from ds_orchestrator.engines.fingerprint import differences, fingerprint
from ds_orchestrator.engines.parcel import Parcel

LOG = logger_of(__name__)

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
_LOOK = 0.5
"""Seconds between two looks at the scheduler."""


@dataclass(frozen=True)
class RemoteWorker:
    """Worker that has the parcel.

    Attributes:
        address: its address.
        threads: batches that it drives at a time.
        largest_batch: drives that one of its processes takes at a time.
    """

    address: str
    threads: int
    largest_batch: int


class Members(Protocol):
    """Callbacks of `Membership`, called from its threads."""

    def worker_ready(self, worker: RemoteWorker) -> None:
        """Handle a worker that may drive."""

    def worker_lost(self, address: str) -> None:
        """Handle a worker that is gone, silent, or behind a scheduler that is gone; it may not have been ready."""

    def cluster_lost(self, reason: str) -> None:
        """Handle the end: nothing comes back within the limits. `reason` is one line."""


class Membership:
    """Watches a scheduler, prepares workers that join, and reports those that are lost.

    Args:
        address: address of the scheduler.
        options: how to connect to it again.
        client: connected `distributed.Client`.
        parcel: what every worker needs.
        command_timeout: wall-clock time for one answer of the driver, s.
        members: receives what changes.

    Attributes:
        client: client that is connected now.
    """

    def __init__(
        self,
        address: str,
        options: ClusterOptions,
        client: Any,
        parcel: Parcel,
        *,
        command_timeout: float,
        members: Members,
    ) -> None:
        self.client = client
        self._address, self._options, self._parcel, self._timeout = address, options, parcel, command_timeout
        self._members = members
        self._sha256, self._here = parcel.sha256, fingerprint(parcel.backend, parcel.simulators)
        self._changed = threading.Condition()
        self._known: dict[str, bool] = {}
        """Address -> whether the worker is ready."""
        self._heartbeats: dict[str, tuple[float, float]] = {}
        """Address -> time of the last heartbeat by the scheduler's clock, and when this process saw it change."""
        self._refusals: dict[str, str] = {}
        self._closed, self._failure = False, ""
        self._thread = threading.Thread(target=self._watch, name="membership", daemon=True)
        self._thread.start()

    def wait_for_worker(self, limit: float = FIRST_WORKER_TIME) -> None:
        """Wait until a worker is ready.

        Raises:
            ClusterError: none is ready within `limit` seconds; gives the reason of the first one that was refused.
        """
        began, told = time.monotonic(), False
        with self._changed:
            while not any(self._known.values()):
                waited = time.monotonic() - began
                if self._failure:
                    raise ClusterError(self._failure)
                if waited > limit or (self._refusals and self._known.keys() <= self._refusals.keys()):
                    why = next(iter(self._refusals.values()), "there is none: start one with `dask worker ADDRESS`")
                    raise ClusterError(f"no usable worker at {self._address}: {why}")
                if not told and not self._known and waited > 3.0:
                    told = True
                    LOG.info("waiting for a worker at %s, %.0f s at most", self._address, limit)
                self._changed.wait(_LOOK)

    def forget(self, address: str) -> None:
        """Take no account of a worker any more; if it is still there, it is prepared again."""
        with self._changed:
            self._known.pop(address, None)
            self._heartbeats.pop(address, None)
            self._refusals.pop(address, None)
        self._members.worker_lost(address)

    def close(self) -> None:
        """Stop watching."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(CONTACT_TIME + _LOOK)

    def _watch(self) -> None:
        without_since = time.monotonic()
        while not self._closed:
            try:
                contact = self.client.sync(self.client.scheduler.identity, n_workers=-1, callback_timeout=CONTACT_TIME)
                present = contact["workers"]
            except Exception:  # whatever the library raises, there was no answer
                if not self._reconnect():
                    return
                without_since = time.monotonic()
                continue
            self._compare(present)
            with self._changed:
                if any(self._known.values()):
                    without_since = time.monotonic()
                lost = time.monotonic() - without_since > NO_WORKER_TIME
            if lost:
                self._fail(f"no worker at {self._address} for {NO_WORKER_TIME:.0f} s: start one, and resume")
                return
            self._pause(_LOOK)

    def _compare(self, present: dict[str, Any]) -> None:
        """Prepare new workers, and give up lost and silent ones."""
        now = time.monotonic()
        for address in self._known.keys() - present.keys():
            if self._known[address]:
                LOG.warning("worker %s is gone: others take over its drives", address)
            self.forget(address)
        for address, about in present.items():
            beat = float(about.get("last_seen", 0.0))
            if self._heartbeats.get(address, (None, 0.0))[0] != beat:
                self._heartbeats[address] = (beat, now)
            silent = now - self._heartbeats[address][1] > SILENCE
            if silent and self._known.get(address):
                LOG.warning("worker %s has been silent for %.0f s: others take over its drives", address, SILENCE)
                heartbeat = self._heartbeats[address]
                self.forget(address)
                self._heartbeats[address] = heartbeat
            elif not silent and address not in self._known:
                self._known[address] = False
                threading.Thread(target=self._prepare, args=(address, about), daemon=True).start()

    def _prepare(self, address: str, about: dict[str, Any]) -> None:
        """Check that a worker computes the same bits, give it the parcel, and let it drive."""
        try:
            # First by itself: Dask loses the error of a function whose module cannot be imported.
            self._on(address, exec, f"import {dask_worker.__name__}", {})
            found = self._on(address, dask_worker.describe, self._sha256, self._parcel.backend, self._parcel.simulators)
            problem = found.get("error") or differences(self._here, found["fingerprint"])
            if not problem:
                # The files travel once per worker.
                known = "largest_batch" in found
                ready = found if known else self._on(address, dask_worker.prepare, self._parcel, self._timeout)
                problem = ready.get("error")
        except Exception as error:  # a task on another machine may raise anything
            what = " ".join(f"{type(error).__name__}: {error}".split())[:200]
            self._refuse(address, f"cannot prepare itself ({what}): is Digital Siblings installed there?")
            return
        if problem:
            self._refuse(address, f"is refused: {problem}")
            return
        with self._changed:
            if self._closed or address not in self._known:
                return
            self._known[address] = True
            # With the lock, so that a loss is reported after it.
            self._members.worker_ready(RemoteWorker(address, int(about["nthreads"]), int(ready["largest_batch"])))
            self._changed.notify_all()

    def _refuse(self, address: str, what: str) -> None:
        line = f"worker {address} {what}"
        with self._changed:
            if self._closed or address not in self._known:
                return
            self._refusals[address] = line
            self._changed.notify_all()
        LOG.warning(line)

    def _on(self, address: str, function: Callable[..., Any], *arguments: Any) -> Any:
        task = self.client.submit(
            function, *arguments, workers=[address], allow_other_workers=False, pure=False, retries=0
        )
        try:
            return task.result(timeout=PREPARE_TIME)
        finally:
            with suppress(Exception):
                task.release()

    def _reconnect(self) -> bool:
        """Report all workers as lost, and wait for the scheduler to come back; return whether it did."""
        if self._closed:
            return False
        for address in list(self._known):
            self.forget(address)
        self._heartbeats.clear()
        LOG.warning("the scheduler at %s does not answer: waiting %.0f s at most", self._address, SCHEDULER_TIME)
        with suppress(Exception):
            self.client.close(timeout=1.0)
        deadline = time.monotonic() + SCHEDULER_TIME
        while not self._closed:
            try:
                self.client = connect(self._address, self._options, limit=CONTACT_TIME / 2)
            except ClusterError:
                if time.monotonic() > deadline:
                    self._fail(f"the scheduler at {self._address} did not come back: start it, and resume")
                    return False
                self._pause(1.0)
                continue
            LOG.info("the scheduler at %s is back", self._address)
            return True
        return False

    def _fail(self, reason: str) -> None:
        with self._changed:
            self._failure = reason
            self._changed.notify_all()
        self._members.cluster_lost(reason)

    def _pause(self, seconds: float) -> None:
        with self._changed:
            self._changed.wait_for(lambda: self._closed, seconds)
