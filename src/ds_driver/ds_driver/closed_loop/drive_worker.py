# SPDX-License-Identifier: Apache-2.0
"""Process that drives roads for `ds_driver.closed_loop.worker_process.WorkerProcess`, without ROS.

Over a `multiprocessing.connection.Connection`, a request is one JSON object (the key and a `DriveRequest`), an answer
the key and the run of `ds_sim.run_codec`; the first says whether the driver was loaded. Nothing is pickled.
"""

from __future__ import annotations

import ctypes
import json
import mmap
import os
import signal
import struct
import sys
from multiprocessing.connection import Connection

from ds_driver.closed_loop.drive_request import DriveRequest, request_from_json
from ds_driver.closed_loop.simulation import ALL_DRIVES, InterleavedDrives, Phase
from ds_driver.networks.driver_name import DriverName
from ds_sim.conditions.model import NotApplicableError
from ds_sim.run_codec import RunCodecError, encode_run
from ds_sim.session import RunRecord
from ds_sim.simulator import Outcome, Reason

_LAYOUT = struct.Struct("<QqI")
KEY = struct.Struct("<q")
"""Key of the drive, which an answer begins with; the encoded run follows."""
LARGEST_ANSWER = 2**30
"""Bytes of an answer at most; chosen: a run of `ds_sim.run_codec.MAX_FRAMES` frames takes a third."""


class PhaseMemory:
    """A few bytes that one process writes and another reads, which opens them with the `descriptor`."""

    def __init__(self, file: int | None = None) -> None:
        if file is None:
            file = os.memfd_create("phase")
            os.ftruncate(file, _LAYOUT.size)
        self.descriptor = file
        self._memory = mmap.mmap(file, _LAYOUT.size)
        self._changes = 0

    def note(self, phase: Phase, key: int) -> None:
        """Write that a phase of a drive has begun."""
        self._changes += 1
        _LAYOUT.pack_into(self._memory, 0, self._changes, key, phase)

    def read(self) -> tuple[int, int, Phase]:
        """Return the number of phases so far, the key of the drive, and the phase."""
        changes, key, phase = _LAYOUT.unpack_from(self._memory, 0)
        return changes, key, Phase(phase)

    def close(self) -> None:
        """Release the memory."""
        self._memory.close()
        os.close(self.descriptor)


def serve(connection: Connection, memory: PhaseMemory, driver: DriverName) -> None:
    """Drive whatever is requested until the other side closes the connection."""
    try:
        drives = InterleavedDrives(driver, memory.note)
    except ValueError as error:
        connection.send_bytes(json.dumps({"error": " ".join(str(error).split())}).encode())
        return
    ctypes.CDLL(None).malloc_trim(0)  # loading a network leaves 20 to 40 MB of free memory behind
    connection.send_bytes(json.dumps({"largest_batch": drives.largest_batch}).encode())
    while True:
        if not len(drives):
            memory.note(Phase.IDLE, ALL_DRIVES)
        while not len(drives) or connection.poll():
            try:
                request = json.loads(connection.recv_bytes())
            except EOFError:
                return
            _begin(connection, drives, request["key"], request_from_json(request))
        for key, run in drives.step():
            _answer(connection, key, run)


def _begin(connection: Connection, drives: InterleavedDrives, key: int, request: DriveRequest) -> None:
    try:
        drives.begin(key, request)
    except NotApplicableError as error:
        _answer(connection, key, request.ended(Outcome.SIM_ERROR, str(error), Reason.NOT_APPLICABLE))
    except Exception as error:  # a simulator of a user may raise anything: an error, never a failure of the driver
        message = f"{type(error).__name__}: {error}".splitlines()[0]
        _answer(connection, key, request.ended(Outcome.SIM_ERROR, message))


def _answer(connection: Connection, key: int, run: RunRecord) -> None:
    try:
        encoded = encode_run(run)
    except RunCodecError as error:  # a simulator whose numbers are not finite
        encoded = encode_run(RunRecord(scenario=run.scenario, outcome=Outcome.SIM_ERROR, message=str(error)))
    connection.send_bytes(KEY.pack(key) + encoded)


def main() -> None:
    """Serve the connection and the memory whose descriptors are the first two arguments; the third is the driver."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which stops its workers
    connection, memory, driver = sys.argv[1:]
    serve(Connection(int(connection)), PhaseMemory(int(memory)), DriverName.parse(driver))


if __name__ == "__main__":
    main()
