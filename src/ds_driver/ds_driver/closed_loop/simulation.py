# SPDX-License-Identifier: Apache-2.0
"""Requests for drives, and drives without ROS: one by one, or several with one question to the network per frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any

from ds_driver.control.autopilot import ROWS_SEEN, Autopilot
from ds_driver.networks.driver_name import AUTOPILOT, DriverName
from ds_driver.networks.images import Crop, ImageError
from ds_driver.networks.pilot import DriverError, Frame, attempt
from ds_road import Road
from ds_road.files import road_from_json, road_to_json
from ds_sim.conditions.model import DEFAULT, Conditions, NotApplicableError
from ds_sim.conditions.text import from_json
from ds_sim.gates.visible_contrast import ContrastProbe
from ds_sim.registry import SimulatorName, make_simulator
from ds_sim.scenario import OfScenario, Scenario
from ds_sim.session import RunRecord, Session
from ds_sim.simulator import Command, Observation, Outcome, Reason, Simulator, SimulatorSpec

if TYPE_CHECKING:
    from ds_driver.networks.network_driver import NetworkDriver

Driver = Callable[[Observation], Command]


@dataclass(frozen=True)
class DriveRequest(OfScenario):
    """One scenario to drive; if `probed`, the contrast of the lines is measured, see `ds_sim.gates`."""

    scenario: Scenario
    driver: DriverName
    simulator: SimulatorName
    probed: bool = False

    def ended(self, outcome: Outcome, message: str, reason: Reason = Reason.NONE) -> RunRecord:
        """Make the record of a drive that ended without a frame."""
        return RunRecord(scenario=self.scenario, outcome=outcome, message=message, reason=reason)


def request_to_json(request: DriveRequest) -> dict[str, Any]:
    """Convert a request to a JSON value."""
    return {
        "simulator": request.simulator,
        "driver": str(request.driver),
        "road": road_to_json(request.road),
        "seed": request.seed,
        "conditions": request.conditions.changed,
        "probed": request.probed,
    }


def request_from_json(value: Mapping[str, Any]) -> DriveRequest:
    """Convert what `request_to_json` made to an equal request; a ValueError if the road or the conditions cannot be."""
    scenario = Scenario(road_from_json(value["road"]), from_json(value["conditions"]), seed=value["seed"])
    driver, simulator = DriverName.parse(value["driver"]), SimulatorName(value["simulator"])
    return DriveRequest(scenario, driver, simulator, probed=value["probed"])


def make_driver(driver: DriverName | str, spec: SimulatorSpec) -> Driver:
    """Make the driver of a name for one simulator: the autopilot with its gains, or a network with its crop.

    Raises:
        ValueError: the name is unknown, or the driver cannot be loaded.
    """
    driver = DriverName.of(driver)
    if driver == AUTOPILOT:
        autopilot = Autopilot(spec.autopilot)
        return lambda frame: autopilot.command(frame.lane.preview_lateral_position, frame.vehicle.speed)
    network = _network(driver)
    return lambda observation: network.command(Frame.of(observation, spec))


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

    A probed run measures the contrast of the lines (`ds_sim.gates`), on whole images unless the simulator takes
    stills.

    Raises:
        ds_sim.NotApplicableError: the simulator cannot realise a condition; there is no run then.

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
    drive = _Drive(simulator, driver, Scenario(road, conditions, seed=seed), probed=probed)
    while drive.driving:
        drive.take(drive.answer())
    return drive.run


class Phase(IntEnum):
    """What a process of drives is doing; the values cross a process boundary."""

    IDLE = 0
    LOADING = 1
    SIMULATING = 2
    DRIVING = 3


NotePhase = Callable[[Phase, int], None]
"""Called with what begins, and with the key of the drive that it is for, or `ALL_DRIVES`."""
ALL_DRIVES = -1
MOST_IDLE = 8
"""Simulators that are kept between drives; chosen: twice a worker's drives at a time. One keeps some 40 MB."""


class InterleavedDrives:
    """Advances its drives in step, and removes each when it ends.

    Records do not depend on what is interleaved. `note` is called when the phase changes, for a supervisor that notices
    a hang; `largest_batch` is the number of drives that the driver answers at once.

    Raises:
        ValueError: the driver cannot be loaded.
    """

    def __init__(self, driver: DriverName, note: NotePhase) -> None:
        self._note = note
        self._driver = driver
        self._network = None if driver == AUTOPILOT else _network(driver)
        self.largest_batch = 1 if self._network is None else self._network.largest_batch
        self._idle: dict[str, list[Simulator]] = {}
        self._active: dict[int, tuple[str, _Drive]] = {}

    def __len__(self) -> int:
        return len(self._active)

    def begin(self, key: int, request: DriveRequest) -> None:
        """Begin a drive; `step` yields its record when it has ended, also where the simulator cannot load the road.

        Raises:
            ValueError: the request is for another driver.
            ds_sim.NotApplicableError: the simulator cannot realise a condition; there is no drive then.
        """
        if request.driver not in (AUTOPILOT, self._driver):
            raise ValueError(f"{request.driver} was not started, expected {self._driver}, or {AUTOPILOT}")
        self._note(Phase.LOADING, key)
        idle = self._idle.setdefault(request.simulator, [])
        simulator = idle.pop() if idle else make_simulator(request.simulator)
        try:
            self._active[key] = request.simulator, self._started(simulator, request)
        except NotApplicableError:
            idle.append(simulator)
            raise

    def _started(self, simulator: Simulator, request: DriveRequest) -> _Drive:
        network, spec = None if request.driver == AUTOPILOT else self._network, simulator.spec
        rows: tuple[int, int] | None = ROWS_SEEN
        if request.probed and not simulator.takes_stills:
            rows = None  # the contrast is measured on whole images
        elif network is not None:
            rows = network.rows_seen(Crop.of(spec), spec.camera.height_px, spec.name)
        simulator.draw_rows(*(rows or (0, spec.camera.height_px)))
        autopilot = make_driver(AUTOPILOT, spec) if network is None else None
        return _Drive(simulator, autopilot, request.scenario, probed=request.probed)

    def step(self) -> list[tuple[int, RunRecord]]:
        """Advance every drive by one frame; return keys and records of those that have ended."""
        waiting = [(key, drive) for key, (_, drive) in self._active.items() if drive.driving]
        if waiting:
            self._note(Phase.DRIVING, ALL_DRIVES)
        frames = [drive.frame() for _, drive in waiting if drive.driver is None]
        of_network = iter([] if self._network is None else _answers(self._network, frames))
        commands = [next(of_network) if drive.driver is None else drive.answer() for _, drive in waiting]
        for (key, drive), command in zip(waiting, commands, strict=True):
            self._note(Phase.SIMULATING, key)
            drive.take(command)
        records = []
        for key, (name, drive) in list(self._active.items()):
            if not drive.driving:
                del self._active[key]
                self._keep(name, drive.simulator)
                records.append((key, drive.run))
        return records

    def _keep(self, name: str, simulator: Simulator) -> None:
        """Keep a simulator for the next drive; close the one that has been idle longest if there are many."""
        simulator.unload()
        self._idle[name] = [*self._idle.pop(name, []), simulator]
        if sum(map(len, self._idle.values())) > MOST_IDLE:
            oldest = next(name for name, idle in self._idle.items() if idle)
            self._idle[oldest].pop(0).close()


def _network(driver: DriverName) -> NetworkDriver:
    """Load a network; the autopilot needs none of its libraries."""
    from ds_driver.networks.network_driver import NetworkDriver

    return NetworkDriver(driver)


def _answers(network: NetworkDriver, frames: Sequence[Frame]) -> list[Command | DriverError]:
    """Answer frames together; if one has an image that no network takes, each by itself."""
    try:
        return network.commands(frames)
    except ImageError as error:
        return [DriverError(str(error))] if len(frames) == 1 else [_answers(network, [f])[0] for f in frames]


class _Drive:
    """One drive in progress; `driver` answers its frames, or something else does where it is None."""

    def __init__(self, simulator: Simulator, driver: Driver | None, scenario: Scenario, *, probed: bool) -> None:
        self.simulator, self.driver = simulator, driver
        self._session = Session(simulator)
        self._seen = self._session.start(scenario)
        self._probe = ContrastProbe(self.run, simulator) if probed else None
        self._look()

    @property
    def run(self) -> RunRecord:
        assert self._session.run is not None
        return self._session.run

    @property
    def driving(self) -> bool:
        return self._session.driving

    def frame(self) -> Frame:
        """What a network gets of the frame that waits for an answer."""
        assert self._seen is not None
        return Frame.of(self._seen, self.simulator.spec)

    def answer(self) -> Command | DriverError:
        """Ask the drive's own driver for an answer to the frame that waits for it."""
        assert self.driver is not None and self._seen is not None
        return attempt(self.driver, self._seen)

    def take(self, answer: Command | DriverError) -> None:
        """Drive one step with an answer; as in the ROS graph, a driver without one counts as silent."""
        if isinstance(answer, DriverError):
            self._session.end(Outcome.DRIVER_SILENT, str(answer))
            return
        self._seen = self._session.advance(answer)
        self._look()

    def _look(self) -> None:
        if self._probe is not None:
            self._probe.see(self._seen)
