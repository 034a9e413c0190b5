"""Drives roads in this process and in workers, without ROS: what assessment and comparison share."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

from ds_driver.control import Autopilot
from ds_road import Road
from ds_sim.registry import make_simulator
from ds_sim.session import RunRecord, Session
from ds_sim.simulator import Command, Observation, Simulator, SimulatorSpec

AUTOPILOT = "autopilot"
Driver = Callable[[Observation], Command]


@dataclass(frozen=True)
class Drive:
    """A road to be driven.

    Attributes:
        simulator: name, as the registry knows it.
        driver: `autopilot`, a shipped network, or a weights file.
        road: to drive.
        seed: of the run.
    """

    simulator: str
    driver: str
    road: Road
    seed: int


def make_driver(driver: str, spec: SimulatorSpec) -> Driver:
    """A driver for one simulator: the autopilot with its gains, or a network with its crop.

    Raises:
        ValueError: the name stands for nothing, or the weights cannot be used.
    """
    if driver == AUTOPILOT:
        autopilot = Autopilot(spec.autopilot)
        return lambda seen: autopilot.command(seen.lane.preview_lateral_position, seen.vehicle.speed)
    from ds_driver.network_driver import NetworkDriver
    from ds_driver.preprocessing import Crop

    network, crop = NetworkDriver(driver), Crop(spec.crop_top, spec.crop_bottom)
    return lambda seen: network.command(seen.image, seen.vehicle.speed, crop)


def drive_road(simulator: Simulator, driver: Driver, road: Road, seed: int) -> RunRecord:
    """Drive a road to its end; whatever breaks in the simulator ends the run as an error."""
    session = Session(simulator)
    observation = session.start(road, seed)
    while session.driving and observation is not None:
        observation = session.advance(driver(observation))
    assert session.run is not None
    return session.run


def drive_all(drives: Sequence[Drive], *, workers: int | None = None) -> Iterator[RunRecord]:
    """Drive every road, in order, in worker processes with one maths thread each.

    Args:
        drives: what to drive.
        workers: processes; the processors of this machine if left out. The records do not depend on their number.

    Yields:
        Each drive's record as soon as it and all before it are there.
    """
    context = multiprocessing.get_context("spawn")
    count = min(workers or len(os.sched_getaffinity(0)), max(len(drives), 1))
    with ProcessPoolExecutor(count, mp_context=context, initializer=_begin) as pool:
        try:
            yield from pool.map(_drive, drives)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


_made: dict[tuple[str, str], tuple[Simulator, Driver]] = {}


def _begin() -> None:
    """Leave Ctrl-C to the parent and die with it; one maths thread, so that workers do not fight."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ["OMP_NUM_THREADS"] = "1"
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """A parent that was killed cannot stop its pool."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _drive(drive: Drive) -> RunRecord:
    key = (drive.simulator, drive.driver)
    if key not in _made:
        simulator = make_simulator(drive.simulator)
        _made[key] = simulator, make_driver(drive.driver, simulator.spec)
    simulator, driver = _made[key]
    if drive.driver == AUTOPILOT:  # it keeps the last error; networks keep nothing
        driver = make_driver(AUTOPILOT, simulator.spec)
    return drive_road(simulator, driver, drive.road, drive.seed)
