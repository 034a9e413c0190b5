# SPDX-License-Identifier: Apache-2.0
"""The file that says what a campaign does at this moment.

The campaign replaces the file once a second and removes it at its end. No result depends on it.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, Field, ValidationError

from ds_base.folder_files import StoreError, read_file, write_whole
from ds_driver.closed_loop.simulation import DriveRequest
from ds_orchestrator.campaign.engine import Watch
from ds_orchestrator.campaign.executor import Listener
from ds_orchestrator.campaign.folder import LIVE
from ds_orchestrator.campaign.time_left import TimedListener
from ds_orchestrator.store.model import Execution, Test
from ds_sim.gates.gate import Gate
from ds_sim.registry import SimulatorName

EVERY = 1.0
"""Seconds between two writings of the file; chosen: as often as a page asks."""
FRESH = 10.0
"""Age of the file, s, from which its campaign counts as killed; chosen: ten writings, as machines may be busy."""
MOST_DRIVES = 256
"""Drives under way in the file, the oldest; chosen: `MOST_WORKERS` workers of four simulators."""
_LARGEST = 2**18
"""Bytes; chosen: the file with `MOST_DRIVES` drives fits twice."""
_Name = Field(max_length=200)
_Count = Annotated[int, Field(ge=0, le=2**63 - 1)]
_Real = Annotated[float, Field(allow_inf_nan=False)]


class LiveDrive(BaseModel):
    """A drive under way."""

    simulator: Annotated[SimulatorName, _Name]
    road_id: Annotated[str, _Name]
    seed: _Count
    began: _Real  # time at which the engine took it, s since 1970
    step: _Count | None = None  # frames so far; this and what follows are None from engines that give no feedback
    progress: Annotated[float, Field(ge=0.0, le=1.0)] | None = None  # driven part of the road, in [0, 1]
    lateral_position: _Real | None = None  # metres from the lane's centre, positive to the right


class Live(BaseModel):
    """What a campaign does."""

    updated: _Real  # time of writing, s since 1970
    stage: Annotated[str, _Name] = ""  # name of the stage, or ""
    done: _Count = 0  # executions that are finished, those of earlier sessions included
    total: _Count = 0  # executions that are expected at the end, or 0 if that is not known yet
    # Estimate of the time that driving still takes, or None.
    seconds_left: Annotated[float, Field(ge=0.0, allow_inf_nan=False)] | None = None
    drives: list[LiveDrive] = Field(default=[], max_length=MOST_DRIVES)  # drives under way, the oldest first


def read_live(folder: Path, now: float) -> Live | None:
    """Read what the campaign in a folder does at a time, s since 1970; None if none runs, or one of an old version."""
    try:
        live = Live.model_validate_json(read_file(folder, LIVE, _LARGEST))
    except (OSError, StoreError, ValidationError):
        return None
    return live if abs(now - live.updated) < FRESH else None


class LiveFile(TimedListener):
    """Listener that keeps the file up to date and forwards every call; a context manager that removes the file.

    A file that cannot be written, as on a full disk, does not disturb the campaign.
    """

    def __init__(self, folder: Path, listener: Listener) -> None:
        super().__init__()
        self._path, self._listener = folder / LIVE, listener
        self._ended, self._stage = threading.Event(), ""
        self._drives: dict[int, LiveDrive] = {}
        self._thread = threading.Thread(target=self._keep_writing, name="live file", daemon=True)

    def __enter__(self) -> LiveFile:
        self._write()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()
        with suppress(OSError):
            self._path.unlink()

    def stage(self, name: str) -> None:
        """See `Listener.stage`."""
        self._stage = name
        super().stage(name)
        self._listener.stage(name)

    def expect(self, stages: Sequence[Mapping[SimulatorName, int]]) -> None:
        """See `Listener.expect`."""
        super().expect(stages)
        self._listener.expect(stages)

    def finished(self, test: Test, simulator: SimulatorName, execution: Execution | Gate | None, fresh: bool) -> None:
        """See `Listener.finished`."""
        super().finished(test, simulator, execution, fresh)
        self._listener.finished(test, simulator, execution, fresh)

    @contextmanager
    def driving(self, request: DriveRequest) -> Iterator[Watch]:
        """Enter a drive under way into the file."""
        # Not checked: what is wrong with a name must not end a campaign here.
        drive = LiveDrive.model_construct(
            simulator=request.simulator, road_id=request.road.road_id, seed=request.seed, began=time.monotonic()
        )

        def watch(step: int, progress: float, lateral_position: float) -> None:
            drive.step, drive.progress, drive.lateral_position = step, progress, lateral_position

        with self._lock:
            self._drives[id(drive)] = drive
        try:
            yield watch
        finally:
            with self._lock:
                del self._drives[id(drive)]

    def _keep_writing(self) -> None:
        while not self._ended.wait(EVERY):
            self._write()

    def _write(self) -> None:
        with self._lock:
            now, passed = time.time(), time.monotonic()  # the clock on the wall may jump during a drive
            drives = sorted(self._drives.values(), key=lambda drive: drive.began)[:MOST_DRIVES]
            under_way = [(drive.simulator, passed - drive.began, drive.progress) for drive in drives]
            drives = [drive.model_copy(update={"began": now - (passed - drive.began)}) for drive in drives]
            live = Live(
                updated=now,
                stage=self._stage,
                done=self.done,
                total=self.total,
                seconds_left=self.seconds_left(under_way) or None,
            )
            text = live.model_copy(update={"drives": drives}).model_dump_json()  # names are not checked here
        with suppress(OSError):
            write_whole(self._path, text)
