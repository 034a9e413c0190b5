# SPDX-License-Identifier: Apache-2.0
"""A process that drives roads, without ROS, and its supervisor, which notices its death or a hang, and starts it again.

Over a `multiprocessing.connection.Connection`, a request is one JSON object (the key and a `DriveRequest`), an answer
the key and the run of `ds_sim.run_codec`; the first says whether the driver was loaded. Nothing is pickled.
"""

from __future__ import annotations

import ctypes
import json
import mmap
import os
import signal
import socket
import struct
import sys
import threading
import time
from concurrent.futures import Future
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path

from ds_base.errors import RunError
from ds_base.processes import ChildProcesses, RunningClock, last_line_of, python_environment
from ds_driver.closed_loop.simulation import (
    ALL_DRIVES,
    DriveRequest,
    InterleavedDrives,
    Phase,
    request_from_json,
    request_to_json,
)
from ds_driver.networks.driver_name import DriverName
from ds_sim.conditions.model import NotApplicableError
from ds_sim.run_codec import RunCodecError, decode_run, encode_run
from ds_sim.session import RunRecord
from ds_sim.simulator import Outcome, Reason

START_TIME = 90.0
"""Limit for loading the driver, s."""
LOAD_TIME = 90.0
"""Limit for making a simulator and loading a road, s; chosen: importing a simulator on a busy machine takes 10 s."""
TAKE_TIME = 30.0
"""Limit for an idle process to take a drive, and for a message to go on, s; then it is replaced; chosen: as a frame."""
FRAME_TIME = 30.0
"""Limit for one frame of a simulator, s; chosen: a thousand times the slowest one that is shipped."""
DEATHS = 3
"""Deaths of the process that one drive survives; chosen: further ones are taken to be the drive's own fault."""
STARTS = 3
"""Consecutive starts that may fail; chosen: one may be chance."""
_POLL = 0.2
"""Seconds between two looks at a process that is silent."""
_LAYOUT = struct.Struct("<QqI")
_KEY = struct.Struct("<q")
"""Key of the drive, which an answer begins with; the encoded run follows."""
_LARGEST_ANSWER = 2**30
"""Bytes of an answer at most; chosen: a run of `ds_sim.run_codec.MAX_FRAMES` frames takes a third."""


class WorkerError(RunError):
    """A worker process that cannot be started."""


class _Lost(Exception):
    """The process ended while it drove; the argument says how."""


class _PhaseMemory:
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


class WorkerProcess:
    """Drives in a process of its own; may be used from several threads, each of which waits for its drive.

    The driver has `command_timeout` s of wall-clock time for one answer; what the process prints goes to `log`.
    """

    def __init__(self, driver: DriverName, *, command_timeout: float, log: Path) -> None:
        self._driver = driver
        self._limits = {
            Phase.IDLE: TAKE_TIME,
            Phase.LOADING: LOAD_TIME,
            Phase.SIMULATING: FRAME_TIME,
            Phase.DRIVING: command_timeout,
        }
        self._log = log
        self._lock = threading.Lock()
        self._children = ChildProcesses()
        self._process: _Process | None = None
        self._stopped = False
        self._next = 0

    def start(self) -> int:
        """Start the process unless it runs; return how many drives it answers at once. A WorkerError if it does not."""
        with self._lock:
            return self._running().largest_batch

    def drive(self, request: DriveRequest) -> RunRecord:
        """Drive a road; errors, `stop` and deaths are outcomes, but not a start that fails, a WorkerError."""
        deaths = 0
        while True:
            with self._lock:
                if self._stopped:
                    return request.ended(Outcome.CANCELLED, "stopped")
                process = self._running()
                self._next += 1
                answer = process.request(self._next, request)
            try:
                return answer.result()
            except _Lost as lost:
                deaths += 1
                if self._stopped:
                    return request.ended(Outcome.CANCELLED, "stopped")
                if deaths >= DEATHS:
                    return request.ended(Outcome.SIM_ERROR, f"its process ended {deaths} times: {lost}")

    def stop(self) -> None:
        """End every drive now, as CANCELLED."""
        self._stopped = True
        with self._lock:
            if self._process is not None:
                self._process.child.kill()

    def close(self) -> None:
        """End the process."""
        self.stop()
        with self._lock:
            if self._process is not None:
                self._process.child.wait()
                self._process.reader.join()
            self._children.close()

    @property
    def pid(self) -> int | None:
        """Process id; None before the first start."""
        return None if self._process is None else self._process.child.pid

    def _running(self) -> _Process:
        failed = ""
        for _ in range(STARTS):
            if self._process is not None and self._process.alive:
                return self._process
            try:
                self._process = _Process(self._children, self._driver, self._limits, self._log)
            except _Lost as lost:
                failed = str(lost)
        raise WorkerError(f"a worker process did not start {STARTS} times in a row: {failed}")


class _Process:
    """One start of the process, and the drives that it has."""

    def __init__(self, children: ChildProcesses, driver: DriverName, limits: dict[Phase, float], log: Path) -> None:
        self._log, self._limits = log, limits
        self._connection, theirs = Pipe()
        with socket.socket(fileno=os.dup(self._connection.fileno())) as ours:  # it may stop in the middle of a message
            for option in (socket.SO_RCVTIMEO, socket.SO_SNDTIMEO):
                ours.setsockopt(socket.SOL_SOCKET, option, struct.pack("ll", int(limits[Phase.IDLE]), 0))
        self._memory = _PhaseMemory()
        descriptors = (theirs.fileno(), self._memory.descriptor)
        self.child = children.start(
            [sys.executable, "-m", __name__, *map(str, (*descriptors, driver))],
            environment=python_environment(),
            log=log,
            pass_fds=descriptors,
        )
        theirs.close()
        self.largest_batch = self._greeting()
        self._lock = threading.Lock()
        self._drives: dict[int, tuple[DriveRequest, Future[RunRecord]]] = {}
        self._ended = ""
        self.reader = threading.Thread(target=self._read, name="drives", daemon=True)
        self.reader.start()

    @property
    def alive(self) -> bool:
        return not self._ended and self.child.poll() is None

    def request(self, key: int, asked: DriveRequest) -> Future[RunRecord]:
        answer: Future[RunRecord] = Future()
        with self._lock:
            if self._ended:
                answer.set_exception(_Lost(self._ended))
                return answer
            self._drives[key] = (asked, answer)
        try:
            self._connection.send_bytes(json.dumps({"key": key, **request_to_json(asked)}).encode())
        except OSError:  # it has ended, or takes nothing any more; the reader sees the end
            self.child.kill()
        return answer

    def _greeting(self) -> int:
        deadline = time.monotonic() + START_TIME
        while not self._connection.poll(_POLL):
            if self.child.poll() is not None and not self._connection.poll():
                raise self._lost()
            if time.monotonic() > deadline:
                self.child.kill()
                raise WorkerError(f"a worker process did not load its driver within {START_TIME:.0f} s")
        try:
            greeting = json.loads(self._connection.recv_bytes())
        except EOFError:
            raise self._lost() from None
        except OSError:
            self.child.kill()
            raise self._lost() from None
        if "error" in greeting:
            raise WorkerError(str(greeting["error"]))
        return int(greeting["largest_batch"])

    def _lost(self) -> _Lost:
        self.child.wait()
        status = self.child.returncode
        if status < 0:
            return _Lost(f"killed by signal {-status}")
        return _Lost(f"exit status {status}, {last_line_of(self._log)}")

    def _read(self) -> None:
        """Hand out answers until the process ends; end it when a phase takes too long."""
        clock = RunningClock()
        noted, since = -1, clock.now()
        while True:
            try:
                if self._connection.poll(_POLL):
                    self._receive(self._connection.recv_bytes(_LARGEST_ANSWER))
                    continue
            except (EOFError, OSError, RunCodecError, struct.error, KeyError):  # it ended, or talks nonsense
                self.child.kill()
                break
            if self.child.poll() is not None:
                break
            changes, key, phase = self._memory.read()
            # It may have been stopped after it answered, before it noted that it is idle.
            if key != ALL_DRIVES and key not in self._drives:
                phase = Phase.IDLE
            now = clock.now()
            if changes != noted or not self._drives:
                noted, since = changes, now
            elif now - since > self._limits[phase]:
                # Somebody may have stopped it: then nothing in it hangs.
                stopped = os.waitid(os.P_PID, self.child.pid, os.WSTOPPED | os.WNOHANG | os.WNOWAIT)
                if phase is not Phase.IDLE and not stopped:
                    self._blame(phase, key)
                self.child.kill()
                break
        lost = self._lost()
        with self._lock:
            self._ended = str(lost)
            drives, self._drives = self._drives, {}
        for _, answer in drives.values():
            answer.set_exception(lost)
        self._connection.close()
        self._memory.close()

    def _receive(self, message: bytes) -> None:
        (key,) = _KEY.unpack_from(message)
        run = decode_run(message[_KEY.size :], self._drives[key][0].scenario)
        self._drives.pop(key)[1].set_result(run)

    def _blame(self, phase: Phase, key: int) -> None:
        """End the drives at whose frame the process hangs as errors; the others are driven again."""
        limit = self._limits[phase]
        if phase is Phase.DRIVING:
            outcome, message = Outcome.DRIVER_SILENT, f"no command within {limit:g} s"
        else:
            what = "load the road" if phase is Phase.LOADING else "advance by one frame"
            outcome, message = Outcome.SIM_ERROR, f"the simulator took more than {limit:g} s to {what}"
        for guilty in list(self._drives) if key == ALL_DRIVES else [key]:
            asked, answer = self._drives.pop(guilty)
            answer.set_result(asked.ended(outcome, message))


def serve(connection: Connection, memory: _PhaseMemory, driver: DriverName) -> None:
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
    connection.send_bytes(_KEY.pack(key) + encoded)


def main() -> None:
    """Serve the connection and the memory whose descriptors are the first two arguments; the third is the driver."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which stops its workers
    connection, memory, driver = sys.argv[1:]
    serve(Connection(int(connection)), _PhaseMemory(int(memory)), DriverName.parse(driver))


if __name__ == "__main__":
    main()
