# SPDX-License-Identifier: Apache-2.0
"""Engine `dask`: the engine `local` on any number of machines, behind a Dask scheduler.

A task is one drive, pinned to one worker. Which worker takes which drive, and how often a drive is handed out because a
worker died, changes no byte of a result: a drive depends on its simulator, driver, road, seed and conditions alone, and
only the first answer to it counts.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager
from pathlib import Path

from ds_base.folder_files import enter_folder
from ds_base.processes import check_semaphores
from ds_base.progress import logger_of
from ds_driver.closed_loop.drive_request import DriveRequest, request_to_json
from ds_orchestrator.campaign.engine import DriveSettings, Watch
from ds_orchestrator.engines import dask_worker
from ds_orchestrator.engines.cluster import ClusterOptions, own_cluster
from ds_orchestrator.engines.membership import Membership, WorkerLostError
from ds_orchestrator.engines.parcel import parcel_of
from ds_sim.run_codec import decode_run
from ds_sim.session import RunRecord
from ds_sim.simulator import Outcome

LOG = logger_of(__name__)

MOST_THREADS = 256
"""Drives that a campaign has ready at a time, each with a waiting thread; chosen: 64 cores with four drives each."""
LOSSES = 5
"""Workers that one drive may lose; chosen: further ones are taken to be the drive's own fault."""


class DaskEngine:
    """Drives on the workers of a cluster that are prepared under a key."""

    def __init__(self, key: dask_worker.Key, membership: Membership) -> None:
        self._key, self._membership = key, membership

    @property
    def capacity(self) -> int | None:
        """Drives at a time; more than most clusters take, as workers may join."""
        return MOST_THREADS

    def drive(self, request: DriveRequest, watch: Watch | None = None) -> RunRecord:
        """Drive a road on some worker; waits for one that is free, and gives no feedback.

        Raises:
            RunError: the scheduler or all workers are gone for too long.
        """
        losses: list[str] = []
        while len(losses) < LOSSES:
            try:
                with self._membership.free_worker() as call:
                    encoded = call(dask_worker.drive, self._key, request_to_json(request))
                    if encoded is None:
                        raise ValueError("the worker was restarted under its address")
                    return decode_run(encoded, request.scenario)
            except CancelledError:
                return request.ended(Outcome.CANCELLED, "stopped")
            except WorkerLostError as lost:
                losses.append(str(lost))
        message = f"{LOSSES} workers were lost while they drove it {losses[-1]}".rstrip()
        return request.ended(Outcome.SIM_ERROR, message)

    def stop(self) -> None:
        """End every drive now, as CANCELLED."""
        self._membership.stop()


@contextmanager
def running_dask(settings: DriveSettings, *, folder: Path) -> Iterator[DaskEngine]:
    """Connect to the cluster, or start one, with files in a folder; yield an engine, and leave the cluster.

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
            check_semaphores()
            enter_folder(folder)
            address = stack.enter_context(own_cluster(settings.workers, options, folder))
            if options.listen != ClusterOptions().listen:
                LOG.info("further workers may join: dask worker %s", address)
        key = parcel.sha256, settings.command_timeout
        membership = Membership(address, options, parcel, key)
        stack.callback(membership.close)
        membership.wait_for_worker()
        yield DaskEngine(key, membership)
