# SPDX-License-Identifier: Apache-2.0
"""Worker processes drive as this process does, whatever dies or hangs."""

from __future__ import annotations

import os
import re
import signal
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from tests.drives import driven
from tests.engines.quick_simulator import NONSENSE

from ds_driver.closed_loop import worker_process
from ds_driver.closed_loop.simulation import DriveRequest, Phase
from ds_driver.closed_loop.worker_process import WorkerError, WorkerProcess
from ds_driver.networks.driver_name import AUTOPILOT, DriverName
from ds_road import Road, generate
from ds_sim.conditions.model import Conditions
from ds_sim.registry import DONKEY, SimulatorName
from ds_sim.run_codec import encode_run
from ds_sim.scenario import Scenario
from ds_sim.session import RunRecord
from ds_sim.simulator import Outcome

QUICK = "tests.engines.quick_simulator"
ROAD = generate(np.random.default_rng(3), max_angle=150)
SHORT = Road(ROAD.control_points[:4])


def request(simulator: str = "QuickSimulator", seed: int = 1, driver: DriverName = AUTOPILOT) -> DriveRequest:
    """A drive of the road on a simulator of `quick_simulator.py`."""
    return DriveRequest(Scenario(ROAD, seed=seed), driver, SimulatorName(f"{QUICK}:{simulator}"))


class Processes:
    """Makes worker processes, and closes them."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.made: list[WorkerProcess] = []

    def __call__(self, driver: str = "autopilot", timeout: float = 20.0) -> WorkerProcess:
        log = self._folder / f"worker_{len(self.made)}.log"
        self.made.append(WorkerProcess(DriverName.parse(driver), command_timeout=timeout, log=log))
        return self.made[-1]


@pytest.fixture
def worker(tmp_path: Path) -> Iterator[Processes]:
    processes = Processes(tmp_path)
    yield processes
    for one in processes.made:
        one.close()


def drive_all(process: WorkerProcess, drives: Sequence[DriveRequest]) -> list[RunRecord]:
    with ThreadPoolExecutor(len(drives)) as pool:
        return list(pool.map(process.drive, drives))


@pytest.mark.parametrize(
    "driver",
    [
        "autopilot",
        "dave2_short@openvino",
        pytest.param("dave2", marks=pytest.mark.long),
        pytest.param("chauffeur@openvino", marks=pytest.mark.long),
        pytest.param("epoch@openvino", marks=pytest.mark.long),
    ],
)
def test_interleaved_drives_are_the_same_bytes_as_single_ones(worker: Processes, driver: str) -> None:
    drives = [
        DriveRequest(Scenario(SHORT, seed=seed), DriverName.parse(driver), SimulatorName(name))
        for seed in (5, 6)
        for name in ("bullet", "softbody", "donkey")
    ]
    gate = DriveRequest(Scenario(SHORT, Conditions(visibility=100.0), seed=5), AUTOPILOT, DONKEY, probed=True)
    *runs, gated = drive_all(worker(driver), [*drives, gate])
    for one, run in zip([*drives, gate], [*runs, gated], strict=True):
        alone = driven(one.simulator, one.road, one.seed, one.conditions, driver=one.driver, probed=one.probed)
        assert run.outcome.is_verdict and run.steps > 20
        assert encode_run(run) == encode_run(alone), f"{driver} on {one.simulator}"
    assert gated.visible_contrasts


def test_a_killed_process_loses_nothing(worker: Processes) -> None:
    process = worker()
    drives = [request("SlowSimulator", seed) for seed in range(6)]
    undisturbed = [encode_run(run) for run in drive_all(process, drives)]
    with ThreadPoolExecutor(len(drives)) as pool:
        futures = [pool.submit(process.drive, one) for one in drives]
        for pause in (0.1, 0.3):
            time.sleep(pause)
            pid = process.pid
            assert pid is not None
            os.kill(pid, signal.SIGKILL)
            while process.pid == pid:
                time.sleep(0.02)
            process.start()
        assert [encode_run(future.result()) for future in futures] == undisturbed


@pytest.mark.parametrize("noted", [Phase.IDLE, Phase.SIMULATING])
def test_what_a_stopped_process_was_given_is_driven_by_another(
    worker: Processes, monkeypatch: pytest.MonkeyPatch, noted: Phase
) -> None:
    """Also if it was stopped before it noted that its last drive is over."""
    monkeypatch.setattr(worker_process, "TAKE_TIME", 4.0)
    process, drive = worker(), request()
    undisturbed, pid = process.drive(drive), process.pid
    assert pid is not None
    os.kill(pid, signal.SIGSTOP)
    assert process._process is not None
    process._process._memory.note(noted, key=1)
    assert encode_run(process.drive(drive)) == encode_run(undisturbed) and process.pid != pid


def test_what_a_stopped_process_drives_is_no_error(worker: Processes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker_process, "FRAME_TIME", 2.0)
    process, drive = worker(), request("SlowSimulator")
    undisturbed, pid = process.drive(drive), process.pid
    assert pid is not None
    with ThreadPoolExecutor(1) as pool:
        again = pool.submit(process.drive, drive)
        assert process._process is not None
        while process._process._memory.read()[2] is not Phase.SIMULATING:
            time.sleep(0.01)
        os.kill(pid, signal.SIGSTOP)
        assert encode_run(again.result()) == encode_run(undisturbed) and process.pid != pid


def test_a_process_that_stops_in_the_middle_of_an_answer_loses_nothing(
    worker: Processes, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(worker_process, "TAKE_TIME", 2.0)
    monkeypatch.setenv("DS_TEST_ONCE", str(tmp_path / "once"))
    drives = [request("HalfAnsweringSimulator", seed) for seed in range(3)]
    process = worker()
    disturbed, again = drive_all(process, drives), drive_all(process, drives)
    assert all(run.outcome.is_verdict for run in disturbed)
    assert list(map(encode_run, disturbed)) == list(map(encode_run, again))


def test_a_drive_that_kills_its_process_ends_as_an_error_and_spares_the_others(worker: Processes) -> None:
    process = worker()
    crash = process.drive(request("CrashingSimulator"))
    assert crash.outcome is Outcome.SIM_ERROR and "signal 11" in crash.message and "\n" not in crash.message
    assert process.drive(request()).outcome.is_verdict


@pytest.mark.parametrize("seed", range(len(NONSENSE)))
def test_an_answer_that_makes_no_sense_ends_as_an_error(worker: Processes, seed: int) -> None:
    run = worker().drive(request("BabblingSimulator", seed))
    assert (run.outcome, run.message) == (Outcome.SIM_ERROR, "its process ended 3 times: killed by signal 9")


@pytest.mark.parametrize(
    ("simulator", "message"), [("RaisingSimulator", "RuntimeError: no licence$"), ("DivergingSimulator", ".*finite")]
)
def test_a_simulator_that_cannot_be_made_or_diverges_is_an_error_of_one_line(
    worker: Processes, simulator: str, message: str
) -> None:
    run = worker().drive(request(simulator))
    assert run.outcome is Outcome.SIM_ERROR and re.match(message, run.message) and "\n" not in run.message


def test_a_simulator_that_hangs_is_given_up_and_the_others_drive_on(
    worker: Processes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker_process, "FRAME_TIME", 2.0)
    slow = [request("SlowSimulator", seed) for seed in range(3)]
    runs = drive_all(worker(), [request("HangingSimulator"), *slow])
    assert runs[0].outcome is Outcome.SIM_ERROR and "more than 2 s" in runs[0].message
    assert all(run.outcome.is_verdict for run in runs[1:])


def test_a_driver_that_hangs_is_silent(worker: Processes) -> None:
    hanging = f"{QUICK}:HangingDriver"
    run = worker(hanging, timeout=2.0).drive(request(driver=DriverName(hanging)))
    assert (run.outcome, run.message) == (Outcome.DRIVER_SILENT, "no command within 2 s")


def test_a_driver_that_cannot_be_loaded_is_named_in_one_line(worker: Processes) -> None:
    with pytest.raises(WorkerError, match="unknown driver 'nonsense'"):
        worker("nonsense").start()


def test_stop_ends_every_drive_at_once(worker: Processes) -> None:
    process = worker()
    process.start()
    with ThreadPoolExecutor(1) as pool:
        drive = pool.submit(process.drive, request("HangingSimulator"))
        time.sleep(0.5)
        process.stop()
        assert drive.result(60.0).outcome is Outcome.CANCELLED
