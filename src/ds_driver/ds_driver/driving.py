"""Drives roads in this process and in workers, without ROS: what assessment and comparison share."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache

from ds_driver.control import Autopilot
from ds_driver.workers import in_workers
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
    """Drive every road, in order, in worker processes; the records do not depend on their number."""
    return in_workers(_drive, drives, workers=workers)


@cache
def _simulator(name: str) -> Simulator:
    """One per worker: they take a while to make."""
    return make_simulator(name)


@cache
def _network(driver: str, simulator: str) -> Driver:
    """One per worker; a network keeps nothing of a drive."""
    return make_driver(driver, _simulator(simulator).spec)


def _drive(drive: Drive) -> RunRecord:
    simulator = _simulator(drive.simulator)
    # The autopilot remembers its last error, so every drive gets a new one.
    alone = drive.driver == AUTOPILOT
    driver = make_driver(AUTOPILOT, simulator.spec) if alone else _network(drive.driver, drive.simulator)
    return drive_road(simulator, driver, drive.road, drive.seed)
