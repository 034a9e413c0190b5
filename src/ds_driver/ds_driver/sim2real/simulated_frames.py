# SPDX-License-Identifier: Apache-2.0
"""Simulated images for generators: the autopilot drives random roads that are used nowhere else (paper 4.1.2)."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ds_base.atomic_files import whole_file
from ds_base.bounded_file import open_regular
from ds_base.processes import map_in_processes
from ds_base.progress import Progress
from ds_driver.closed_loop.simulation import make_driver
from ds_driver.data.collection import roads_both_ways
from ds_driver.data.dataset import road_ids
from ds_driver.networks.driver_name import AUTOPILOT
from ds_driver.sim2real.generator import Sim2RealError
from ds_driver.sim2real.settings import HELD_OUT, Sim2RealSettings
from ds_road import Road
from ds_sim.registry import SimulatorName, simulator_of_process
from ds_sim.simulator import Outcome


@dataclass(frozen=True, kw_only=True)
class SimulatedFrames:
    """Images of drives, (n, 160, 320, 3) uint8 RGB, and which of them are of roads held out from training, (n,)."""

    images: NDArray[np.uint8]
    held_out: NDArray[np.bool_]


def sim2real_roads(settings: Sim2RealSettings) -> tuple[Road, ...]:
    """Generate the roads of all drives: each road forwards, then backwards."""
    roads = roads_both_ways(settings.roads, settings.road_seed)
    return tuple(way for road in roads for way in (road, road.reversed()))


def check_roads_are_new(settings: Sim2RealSettings, data_sets: Iterable[Path]) -> None:
    """Refuse, by a Sim2RealError, roads that are in a data set, too."""
    ids = {road.road_id for road in sim2real_roads(settings)}
    for folder in data_sets:
        if used := ids & road_ids(folder):
            raise Sim2RealError(
                f"{len(used)} of the roads are in {folder}, too, expected new ones: choose another --seed"
            )


def simulated_frames(
    simulator: SimulatorName, settings: Sim2RealSettings, file: Path, progress: Progress
) -> SimulatedFrames:
    """Drive the roads, or read the `.npz` of an earlier call; a Sim2RealError if damaged or of other settings."""
    relevant = {name: getattr(settings, name) for name in ("roads", "seed", "road_seed", "every", "longest")}
    identity = json.dumps({"simulator": simulator, **relevant})
    roads = sim2real_roads(settings)
    if file.exists():
        images, numbers = _read(file, identity)
    else:
        drives, work = [], partial(_drive, simulator, settings, roads)
        progress.start(len(roads))
        for drive in map_in_processes(work, range(len(roads)), workers=settings.threads):
            drives.append(drive)
            progress.advance(line=f"{simulator}: {len(drive)} images")
        images = np.concatenate(drives)
        numbers = np.repeat(np.arange(len(drives), dtype=np.int32), list(map(len, drives)))
        with whole_file(file) as unfinished, unfinished.open("wb") as stream:
            np.savez(stream, images=images, drives=numbers, identity=np.array(identity))
    held_out_roads = max(1, round(HELD_OUT * len(roads) / 2))  # each driven both ways
    return SimulatedFrames(images=images, held_out=numbers >= len(roads) - 2 * held_out_roads)


def _read(file: Path, identity: str) -> tuple[NDArray[np.uint8], NDArray[np.int32]]:
    try:
        with open_regular(file) as content, np.load(content, allow_pickle=False) as stored:
            identity_there = str(stored["identity"])
            images, drives = stored["images"], stored["drives"]
            if drives.shape != images.shape[:1] or drives.dtype != np.int32 or images.dtype != np.uint8:
                raise ValueError("its arrays do not belong together")
    except Exception as error:  # damaged files make the reader raise arbitrary errors
        raise Sim2RealError(f"{file} cannot be read ({type(error).__name__}): delete it and train again") from None
    if identity_there != identity:
        raise Sim2RealError(f"{file} has other simulated drives: choose another --out, or delete the folder")
    return images, drives


def _drive(name: str, settings: Sim2RealSettings, roads: tuple[Road, ...], index: int) -> NDArray[np.uint8]:
    simulator, longest = simulator_of_process(name), settings.longest
    driver = make_driver(AUTOPILOT, simulator.spec)
    seed = int(np.random.default_rng([settings.seed, index]).integers(2**31))
    observation = simulator.load(roads[index], seed=seed)
    images = []
    while observation.outcome is Outcome.RUNNING and (longest is None or observation.step < longest):
        if observation.step % settings.every == 0:
            images.append(observation.image.copy())
        observation = simulator.step(driver(observation))
    return np.array(images)
