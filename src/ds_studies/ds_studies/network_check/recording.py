# SPDX-License-Identifier: Apache-2.0
"""Records what the autopilot sees and does on a few short roads, so that a network can be asked about it open-loop."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ds_base.errors import InputError
from ds_base.processes import map_in_processes
from ds_base.progress import Progress
from ds_driver.closed_loop.simulation import make_driver
from ds_driver.networks.driver_name import AUTOPILOT
from ds_driver.networks.pilot import Frame, Pilot
from ds_road import Side
from ds_sim.registry import SimulatorName, simulator_of_process
from ds_sim.scenario import Scenario
from ds_sim.session import Session
from ds_sim.simulator import Command, SimulatorError
from ds_studies.steering_roads import candidate_roads

if TYPE_CHECKING:
    from ds_analysis.common.statistics import Indices

ROADS = 2
"""Short roads, each driven in both directions, which balances left and right; chosen: some seconds a simulator."""
LONGEST = 240
"""Frames of a drive, 12 s; chosen: the first two bends."""
EVERY = 8
"""Frames from one kept image to the next, 0.4 s; chosen: closer ones look alike."""
WHOLE = slice(80, 200)
"""Frames of a drive that a network with memory is shown; chosen: six seconds around the first bend, 300 MB in all."""
FEWEST = 24
"""Images from which there is a verdict; chosen: a correlation of 0.93 falls below 0.8 once in 200 (Fisher's z)."""
MOST_THINNED = 3
"""One image of so many is kept at least where other descriptions are tried; chosen: a dozen for a simulator's trial."""


class TooSlowError(InputError):
    """The network takes so long for an image that there is no verdict in time."""


@dataclass(frozen=True, kw_only=True)
class AutopilotDrives:
    """Images of the autopilot's drives on one simulator."""

    simulator: SimulatorName
    frames: tuple[Frame, ...]  # images and speeds, drive after drive
    steering: NDArray[np.float64]  # (frames,) the autopilot's steering, -1 left to +1 right
    throttle: NDArray[np.float64]  # (frames,) its throttle, 0 to 1

    @property
    def drives(self) -> NDArray[np.intp]:
        """(frames,) number of the drive that each image is of."""
        return np.cumsum([0, *(b.step <= a.step for a, b in pairwise(self.frames))])

    def sample(self, step: int) -> AutopilotDrives:
        """Keep one image of so many, evenly over the autopilot's steering, so that sharp bends are among them."""
        return self._only(np.sort(np.argsort(self.steering, kind="stable")[step // 2 :: step]))

    def first_drives(self, count: int) -> AutopilotDrives:
        """Keep whole drives, the first ones."""
        return self._only(np.flatnonzero(self.drives < count))

    def _only(self, kept: Indices) -> AutopilotDrives:
        return replace(
            self, frames=tuple(self.frames[k] for k in kept), steering=self.steering[kept], throttle=self.throttle[kept]
        )


def affordable(
    recordings: Sequence[AutopilotDrives], pace: float, seconds: float, *, asked: int, whole: bool = False
) -> tuple[list[AutopilotDrives], bool]:
    """Keep as many images as a network can be asked about in so many seconds; say if other descriptions can be tried.

    `pace` is in seconds per image; if others are tried, it is `asked` so many times about each. `TooSlowError` if fewer
    than `FEWEST` images are left, or no whole drive where it needs them.
    """

    def thinned(step: int) -> list[AutopilotDrives]:
        if whole:
            return [one.first_drives(max(4 // step, 1)) for one in recordings]
        return [one.sample(step) for one in recordings]

    for search, most in ((True, MOST_THINNED), (False, max(len(one.frames) for one in recordings))):
        for step in range(1, most + 1):
            kept = list(recordings) if step == 1 else thinned(step)
            count = sum(len(one.frames) for one in kept)
            tried = LONGEST * len(kept) if asked > 1 else 0  # its throttle
            if count >= FEWEST and pace * (asked * count + tried if search else count) <= seconds:
                return kept, search
    needed = sum(len(one.frames) for one in thinned(4)) if whole else FEWEST
    raise TooSlowError(
        f"the network takes {pace:.1f} s for an image, and a verdict needs {needed} of them: give "
        f"--time {2 * math.ceil(pace * needed)}, fewer simulators, or a faster network"
    )


def record(
    simulators: Sequence[SimulatorName], seed: int, progress: Progress, *, whole: bool = False, lane: Side = "right"
) -> list[AutopilotDrives]:
    """Let the autopilot drive in a lane on every simulator; the same seed gives the same images.

    A network with memory is asked about `whole` pieces of drives. `SimulatorError` if a drive ended in an error.
    """
    roads = [one for one in candidate_roads(ROADS, seed) if one.road.reversed().validity.valid][:ROADS]
    kept = WHOLE if whole else slice(None, None, EVERY)
    scenarios = [replace(one, road=way.in_lane(lane)) for one in roads for way in (one.road, one.road.reversed())]
    recordings = []
    progress.start(len(simulators))
    # A simulator in one process, as starting it takes longer than a drive.
    for one in map_in_processes(partial(_record, scenarios, kept), simulators, abandon=True):
        recordings.append(one)
        progress.advance(line=f"the autopilot drove on {one.simulator}")
    return recordings


def _record(scenarios: Sequence[Scenario], kept: slice, simulator: SimulatorName) -> AutopilotDrives:
    driven = [one for scenario in scenarios for one in _drive(simulator, scenario, kept, lambda _: None)[kept]]
    steering, throttle = np.array([(command.steering, command.throttle) for _, command in driven]).T
    frames = tuple(frame for frame, _ in driven)
    return AutopilotDrives(simulator=simulator, frames=frames, steering=steering, throttle=throttle)


def speeds_of_throttle(pilot: Pilot, simulator: SimulatorName, seed: int) -> NDArray[np.float64]:
    """Let the autopilot steer and the network accelerate on the first road; return the speed of each frame, m/s."""
    pilot.start()
    driven = _drive(simulator, candidate_roads(1, seed)[0], slice(None), lambda frame: pilot.predict(frame).throttle)
    return np.array([frame.speed for frame, _ in driven])


def _drive(
    name: str, scenario: Scenario, kept: slice, throttle: Callable[[Frame], float | None]
) -> list[tuple[Frame, Command]]:
    """Let the autopilot drive, with another throttle if any; return frames, with `kept` images, and its commands."""
    simulator = simulator_of_process(name)
    spec, session = simulator.spec, Session(simulator)
    autopilot = make_driver(AUTOPILOT, spec)
    driven = []
    exposed = {max(step - spec.camera.latency, 0) for step in range(LONGEST)[kept]}
    simulator.draw_images(0 in exposed)
    observation = session.start(scenario)
    while observation is not None and session.driving and observation.step < LONGEST:
        frame = replace(Frame.of(observation, spec), image=observation.image.copy())
        command, pedal = autopilot(observation), throttle(frame)
        driven.append((frame, command))
        simulator.draw_images(observation.step + 1 in exposed)
        observation = session.advance(
            command if pedal is None else Command(command.steering, min(max(pedal, 0.0), 1.0))
        )
    if observation is None:
        raise SimulatorError(f"{name}: {session.run.message if session.run else 'no run'}")
    return driven
