"""Drives roads in this process and in workers, without ROS: what assessment and comparison share."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache

from ds_driver.control.autopilot import Autopilot
from ds_driver.networks.pilot import DriverError
from ds_driver.process_pool import map_in_processes
from ds_road import Road
from ds_sim.registry import make_simulator
from ds_sim.session import RunRecord, Session
from ds_sim.simulator import Command, Observation, Outcome, Simulator, SimulatorSpec

AUTOPILOT = "autopilot"
Driver = Callable[[Observation], Command]


@dataclass(frozen=True)
class Drive:
    """A road to be driven.

    Attributes:
        simulator: name, as the registry knows it.
        driver: `autopilot`, or any name that `ds_driver.networks.network_driver.NetworkDriver` takes.
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
        ValueError: the name stands for nothing, or what it stands for cannot be used.
    """
    if driver == AUTOPILOT:
        autopilot = Autopilot(spec.autopilot)
        return lambda seen: autopilot.command(seen.lane.preview_lateral_position, seen.vehicle.speed)
    from ds_driver.networks.network_driver import NetworkDriver
    from ds_driver.networks.preprocessing import Crop

    network, crop = NetworkDriver(driver), Crop(spec.crop_top, spec.crop_bottom)
    return lambda seen: network.command(seen.image, seen.vehicle.speed, crop, seen.step)


def drive_road(simulator: Simulator, driver: Driver, road: Road, seed: int) -> RunRecord:
    """Drive a road to its end; whatever breaks in the simulator or the driver ends the run as an error."""
    session = Session(simulator)
    observation = session.start(road, seed)
    while session.driving and observation is not None:
        try:
            command = driver(observation)
        except DriverError as error:
            # In the graph, too, a driver without an answer is a silent one.
            session.end(Outcome.DRIVER_SILENT, str(error))
            break
        observation = session.advance(command)
    assert session.run is not None
    return session.run


def drive_all(drives: Sequence[Drive], *, workers: int | None = None) -> Iterator[RunRecord]:
    """Drive every road, in order, in worker processes; the records do not depend on their number."""
    return map_in_processes(_drive, drives, workers=workers)


@cache
def _simulator(name: str) -> Simulator:
    """One per worker: they take a while to make."""
    return make_simulator(name)


@cache
def _network(driver: str, simulator: str) -> Driver:
    """One per worker; a driver forgets the last run when one begins."""
    return make_driver(driver, _simulator(simulator).spec)


def _drive(drive: Drive) -> RunRecord:
    simulator = _simulator(drive.simulator)
    # The autopilot remembers its last error, so every drive gets a new one.
    alone = drive.driver == AUTOPILOT
    driver = make_driver(AUTOPILOT, simulator.spec) if alone else _network(drive.driver, drive.simulator)
    return drive_road(simulator, driver, drive.road, drive.seed)
