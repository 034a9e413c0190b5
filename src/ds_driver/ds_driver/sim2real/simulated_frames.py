"""Simulated images for generators: the autopilot drives random roads that are used nowhere else (paper 4.1.2)."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ds_driver.closed_loop.simulation import make_driver
from ds_driver.control.autopilot import AUTOPILOT
from ds_driver.data.collection import roads_both_ways
from ds_driver.data.dataset import road_ids
from ds_driver.processes import Progress, map_in_processes
from ds_driver.sim2real.generator import Sim2RealError
from ds_driver.sim2real.settings import HELD_OUT, Sim2RealSettings
from ds_driver.whole_files import whole_file
from ds_road import Road
from ds_sim.registry import simulator_of_process
from ds_sim.simulator import Outcome, VehicleState

STATE_FIELDS = tuple(VehicleState.__dataclass_fields__)


@dataclass(frozen=True, kw_only=True)
class SimulatedFrames:
    """Images of drives, with the poses from which they were taken.

    Attributes:
        images: (n, 160, 320, 3) uint8 RGB.
        states: (n, 10) vehicle states when the images were exposed, columns as in `STATE_FIELDS`.
        drives: (n,) index of the drive; drive i is on road i // 2, backwards if i is odd.
        steps: (n,) step of the run.
        roads: roads of the drives, in their direction.
    """

    images: NDArray[np.uint8]
    states: NDArray[np.float64]
    drives: NDArray[np.int32]
    steps: NDArray[np.int32]
    roads: tuple[Road, ...]

    @property
    def held_out(self) -> NDArray[np.bool_]:
        """Tell, (n,), which frames are on the last fifth of the roads; these come in consecutive pairs."""
        return self.drives >= _first_held_out(self.roads)

    def state(self, index: int) -> VehicleState:
        """Return the vehicle's state of one image."""
        return VehicleState(**dict(zip(STATE_FIELDS, map(float, self.states[index]), strict=True)))

    def pairs(self) -> NDArray[np.int64]:
        """Return the indices of the held-out frames whose next step follows them at once."""
        follows = (np.diff(self.steps) == 1) & (np.diff(self.drives) == 0) & self.held_out[:-1]
        return np.flatnonzero(follows)


def sim2real_roads(settings: Sim2RealSettings) -> tuple[Road, ...]:
    """Generate the roads of all drives: each road forwards, then backwards."""
    roads = roads_both_ways(settings.roads, settings.road_seed)
    return tuple(way for road in roads for way in (road, road.reversed()))


def check_roads_are_new(settings: Sim2RealSettings, data_sets: Iterable[Path]) -> None:
    """Refuse roads that a data set has, too.

    Raises:
        Sim2RealError: a road is in a data set.
    """
    roads = sim2real_roads(settings)
    ids = {road.road_id for road in roads}
    for folder in data_sets:
        known = road_ids(folder)
        if ids & known:
            raise Sim2RealError(
                f"{len(ids & known)} of the roads are in {folder}, too, expected new ones: choose another --seed"
            )


def simulated_frames(simulator: str, settings: Sim2RealSettings, file: Path, progress: Progress) -> SimulatedFrames:
    """Drive the roads, or read the `.npz` file of an earlier call with the same settings.

    Raises:
        Sim2RealError: the file is damaged or has other settings.
    """
    relevant = {name: getattr(settings, name) for name in ("roads", "seed", "road_seed", "every", "longest")}
    identity = json.dumps({"simulator": simulator, **relevant})
    roads = sim2real_roads(settings)
    if file.exists():
        return _read(file, identity, roads)
    drives, work = [], partial(_drive, simulator, settings, roads)
    for drive in map_in_processes(work, range(len(roads)), workers=settings.threads):
        drives.append(drive)
        progress(len(drives), len(roads), f"{simulator}: {len(drive[0])} images")
    images, states, steps = (np.concatenate([drive[part] for drive in drives]) for part in range(3))
    numbers = np.concatenate([np.full(len(drive[0]), index, np.int32) for index, drive in enumerate(drives)])
    with whole_file(file) as unfinished, unfinished.open("wb") as stream:
        np.savez(stream, images=images, states=states, steps=steps, drives=numbers, identity=np.array(identity))
    return SimulatedFrames(images=images, states=states, drives=numbers, steps=steps, roads=roads)


def _read(file: Path, identity: str, roads: tuple[Road, ...]) -> SimulatedFrames:
    try:
        with np.load(file, allow_pickle=False) as stored:
            found = str(stored["identity"])
            images, states, drives, steps = (stored[name] for name in ("images", "states", "drives", "steps"))
            same = len({len(images), len(states), len(drives), len(steps)}) == 1
            if not same or images.dtype != np.uint8 or images.ndim != 4 or not np.isfinite(states).all():
                raise ValueError("its arrays do not belong together")
    except Exception as error:  # damaged files make the reader raise arbitrary errors
        raise Sim2RealError(f"{file} cannot be read ({type(error).__name__}): delete it and train again") from None
    if found != identity:
        raise Sim2RealError(f"{file} has other simulated drives: choose another --out, or delete the folder")
    return SimulatedFrames(images=images, states=states, drives=drives, steps=steps, roads=roads)


def _first_held_out(roads: tuple[Road, ...]) -> int:
    """Index of the first drive that is held out; each road has two drives."""
    return len(roads) - 2 * max(1, round(HELD_OUT * len(roads) / 2))


def _drive(
    name: str, settings: Sim2RealSettings, roads: tuple[Road, ...], index: int
) -> tuple[NDArray[np.uint8], NDArray[np.float64], NDArray[np.int32]]:
    """Drive one road; images, states when they were exposed, and steps."""
    simulator = simulator_of_process(name)
    spec, longest = simulator.spec, settings.longest
    driver = make_driver(AUTOPILOT, spec)
    seed = int(np.random.default_rng([settings.seed, index]).integers(2**31))
    observation = simulator.load(roads[index], seed=seed)
    states, images, poses, steps = [observation.vehicle], [], [], []
    while observation.outcome is Outcome.RUNNING and (longest is None or observation.step < longest):
        phase = observation.step % settings.every
        if phase == 0 or (phase == 1 and index >= _first_held_out(roads)):
            images.append(observation.image.copy())
            exposed = states[max(0, observation.step - spec.camera.latency)]
            poses.append([float(getattr(exposed, name)) for name in STATE_FIELDS])
            steps.append(observation.step)
        observation = simulator.step(driver(observation))
        states.append(observation.vehicle)
    return np.array(images), np.array(poses), np.array(steps, np.int32)
