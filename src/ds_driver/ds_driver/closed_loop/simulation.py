"""Drives roads in this process or in worker processes, without ROS."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cache
from typing import TYPE_CHECKING

from ds_driver.closed_loop.drawn_rows import draw_seen_rows
from ds_driver.closed_loop.drive_request import AUTOPILOT, DriveRequest
from ds_driver.control.autopilot import ROWS_SEEN, Autopilot
from ds_driver.networks.images import Crop
from ds_driver.networks.pilot import DriverError
from ds_driver.process_pool import map_in_processes
from ds_road import Road
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.gates.visible_contrast import ContrastProbe
from ds_sim.registry import simulator_of_process
from ds_sim.session import RunRecord, Session
from ds_sim.simulator import Command, Observation, Outcome, Simulator, SimulatorSpec

if TYPE_CHECKING:
    from ds_driver.networks.network_driver import NetworkDriver

Driver = Callable[[Observation], Command]


def make_driver(driver: str, spec: SimulatorSpec) -> Driver:
    """Make a driver for one simulator: the autopilot with its gains, or a network with its crop.

    Args:
        driver: name as in `DriveRequest.driver`.
        spec: spec of the simulator.

    Raises:
        ValueError: the name is unknown, or the driver cannot be loaded.
    """
    if driver == AUTOPILOT:
        autopilot = Autopilot(spec.autopilot)
        return lambda frame: autopilot.command(frame.lane.preview_lateral_position, frame.vehicle.speed)
    from ds_driver.networks.network_driver import NetworkDriver

    return _steered_by(NetworkDriver(driver), spec)


def _steered_by(network: NetworkDriver, spec: SimulatorSpec) -> Driver:
    crop = Crop(spec.crop_top, spec.crop_bottom)
    return lambda frame: network.command(frame.image, frame.vehicle.speed, crop, frame.step, spec.name)


def drive_road(
    simulator: Simulator,
    driver: Driver,
    road: Road,
    seed: int,
    conditions: Conditions = DEFAULT,
    *,
    probed: bool = False,
) -> RunRecord:
    """Drive a road until the run ends; failures of simulator or driver end the run as an error.

    Args:
        simulator: draws whole images if the run is probed, unless it satisfies `ds_sim.simulator.TakesStills`.
        driver: answers every frame.
        road: road to drive.
        seed: seed of the run.
        conditions: operating conditions of the run.
        probed: measure the contrast of the lines; see `ds_sim.gates`.

    Raises:
        ds_sim.conditions.NotApplicableError: the simulator cannot realise a condition; there is no run then.

    Examples:
        >>> from ds_driver import drive_road, make_driver
        >>> from ds_road import Road
        >>> from ds_sim import make_simulator
        >>> simulator = make_simulator("softbody")
        >>> driver = make_driver("autopilot", simulator.spec)
        >>> run = drive_road(simulator, driver, Road([(125, 0), (125, 25), (125, 50), (125, 75)]), seed=1)
        >>> run.outcome.name, run.fitness > 1.0
        ('COMPLETED', True)
    """
    session = Session(simulator)
    observation = session.start(road, seed, conditions)
    assert session.run is not None
    probe = ContrastProbe(session.run, simulator) if probed else None
    while observation is not None:
        if probe is not None:
            probe.see(observation)
        if not session.driving:
            break
        try:
            command = driver(observation)
        except DriverError as error:
            # As in the ROS graph, a driver without an answer counts as silent.
            session.end(Outcome.DRIVER_SILENT, str(error))
            break
        observation = session.advance(command)
    return session.run


def drive_all(drives: Sequence[DriveRequest], *, workers: int | None = None) -> Iterator[RunRecord]:
    """Drive all roads in worker processes and yield the records in order; they do not depend on `workers`."""
    return map_in_processes(run_drive, drives, workers=workers)


@cache
def _network(driver: str) -> NetworkDriver:
    """Network of this worker; it is reset when a run starts."""
    from ds_driver.networks.network_driver import NetworkDriver

    return NetworkDriver(driver)


def run_drive(drive: DriveRequest) -> RunRecord:
    """Drive in this process, which keeps simulator and network for the next drive; draws what the driver sees."""
    simulator = simulator_of_process(drive.simulator)
    rows: tuple[int, int] | None = ROWS_SEEN
    if drive.driver == AUTOPILOT:
        # The autopilot keeps its previous error, so every drive gets a new one.
        driver = make_driver(AUTOPILOT, simulator.spec)
    else:
        network, crop = _network(drive.driver), Crop(simulator.spec.crop_top, simulator.spec.crop_bottom)
        driver = _steered_by(network, simulator.spec)
        rows = network.rows_seen(crop, simulator.spec.camera.height_px, simulator.spec.name)
    draw_seen_rows(simulator, rows, probed=drive.probed)
    return drive_road(simulator, driver, drive.road, drive.seed, drive.conditions, probed=drive.probed)
