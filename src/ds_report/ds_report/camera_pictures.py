# SPDX-License-Identifier: Apache-2.0
"""Camera pictures of a report: one place on every simulator; drives rendered again from paths, level, for replays."""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_driver.control.autopilot import Autopilot
from ds_driver.networks.driver_name import AUTOPILOT, DriverName
from ds_driver.networks.network_driver import Translation, generators_of, translation_of
from ds_orchestrator.search.features import Cell
from ds_orchestrator.store.model import Execution, Test
from ds_report.pages import data_address
from ds_sim.camera.encodings import jpeg
from ds_sim.camera.spec import IMAGE_HEIGHT
from ds_sim.parts import Scene
from ds_sim.registry import SimulatorName, make_simulator, received_simulator
from ds_sim.road_simulator import RoadSimulator
from ds_sim.scenario import Scenario
from ds_sim.simulator import FRAME_RATE, Observation, Outcome, Simulator, VehicleState

DRIVEN_TESTS = 24
"""Largest number of tests whose drives all have a strip of pictures; chosen: 1.5 MB, rendered in 8 s."""
MOMENTS = 5
"""Pictures of a strip; chosen: a row of them fits on a screen."""
BEFORE_FAILURE = 1.0
"""Time between pictures of a failed drive's strip, which ends with it, s; chosen: shows the bend in which it fails."""
REPLAY_PICTURES = 3000
"""Largest number of pictures of all replays; chosen: 14 MB, so that a report with 5,000 tests has about 31 MB."""
REPLAYS_OF_LARGE = 600
"""The same where a campaign has more tests than a page; chosen: some fifty drives, more than anyone watches."""
SPACINGS = (10, 20, 40)
"""Frames between two pictures of a replay, the first with which all fit; chosen: 0.5 s to 2 s show every bend."""

DriveKey = tuple[str, SimulatorName]
"""A test's id and a simulator."""


@dataclass(frozen=True, kw_only=True)
class PicturePlan:
    """Frames of which a report has pictures."""

    frames: Mapping[DriveKey, Sequence[int]]  # test and simulator -> frames to render, increasing
    strips: int = 0  # number of tests of which every drive has a strip
    spacing: float = SPACINGS[0] / FRAME_RATE  # time between two pictures of a replay, s
    replayed: int = 0  # number of failed drives, of `failed` in all, whose replay has pictures
    failed: int = 0


def plan_pictures(
    tests: Sequence[Test],
    executions: Sequence[Execution],
    cells: Mapping[str, Cell],
    *,
    strips: int = DRIVEN_TESTS,
    replays: int = REPLAY_PICTURES,
) -> PicturePlan:
    """Choose the frames to render, for at most so many tests with strips, and pictures in replays.

    Failed drives come first, of the worst test before all others, at the finest of `SPACINGS` with which all fit, or
    the coarsest. Other drives of these tests follow as long as there is room. Tests without a cell have no pictures.
    """
    ranked = worst_first((test for test in tests if test.test_id in cells), executions)
    rank = {test_id: k for k, test_id in enumerate(ranked)}
    in_order = sorted((e for e in executions if e.test_id in rank and len(e.trajectory)), key=lambda e: rank[e.test_id])
    failed = [e for e in in_order if e.outcome.is_failure]
    tests_that_fail = {e.test_id for e in failed}
    others = [e for e in in_order if e.test_id in tests_that_fail and not e.outcome.is_failure]

    totals = {spacing: sum(len(replay_frames(e, spacing)) for e in failed) for spacing in SPACINGS}
    spacing = next((s for s in SPACINGS if totals[s] <= replays), SPACINGS[-1])
    frames: dict[DriveKey, list[int]] = {}
    left = replays
    for execution in (*failed, *others):
        chosen = replay_frames(execution, spacing)
        if len(chosen) > left:
            break
        left -= len(chosen)
        frames[execution.test_id, execution.simulator] = chosen
    replayed = sum((e.test_id, e.simulator) in frames for e in failed)

    told = {test.test_id for test in telling_tests(tests, executions, cells, most=strips)}
    for execution in in_order:
        drive = execution.test_id, execution.simulator
        if drive in frames or execution.test_id in told:
            frames[drive] = sorted({*frames.get(drive, ()), *moments(execution)})
    return PicturePlan(
        frames=frames, strips=len(told), spacing=spacing / FRAME_RATE, replayed=replayed, failed=len(failed)
    )


def worst_first(tests: Iterable[Test], executions: Sequence[Execution]) -> list[str]:
    """Sort driven tests: first those that fail on more simulators, then those that come closer to the lane's edge."""
    failures = Counter(execution.test_id for execution in executions if execution.outcome.is_failure)
    nearest: dict[str, float] = {}
    for execution in executions:
        nearest[execution.test_id] = min(nearest.get(execution.test_id, np.inf), execution.fitness)
    ids = (test.test_id for test in tests if test.test_id in nearest)
    return sorted(ids, key=lambda test_id: (-failures[test_id], nearest[test_id], test_id))


def telling_tests(
    tests: Sequence[Test], executions: Sequence[Execution], cells: Mapping[str, Cell], *, most: int = DRIVEN_TESTS
) -> list[Test]:
    """Select the most informative tests, in the campaign's order: the worst of every cell, then others that failed."""
    ranked = worst_first((test for test in tests if test.test_id in cells), executions)
    worst: dict[Cell, str] = {}
    for test_id in ranked:
        worst.setdefault(cells[test_id], test_id)
    failing = {e.test_id for e in executions if e.outcome.is_failure}
    chosen = set(list(dict.fromkeys([*worst.values(), *(i for i in ranked if i in failing)]))[:most])
    return [test for test in tests if test.test_id in chosen]


def moments(execution: Execution) -> list[int]:
    """Select the frames of a strip, increasing: a failed drive's last seconds, else evenly spread ones."""
    last = len(execution.trajectory) - 1
    if last < 0:
        return []
    first = max(0, last - round(BEFORE_FAILURE * FRAME_RATE) * (MOMENTS - 1)) if execution.outcome.is_failure else 0
    return [int(k) for k in np.unique(np.linspace(first, last, MOMENTS).round().astype(int))]


def replay_frames(execution: Execution, spacing: int) -> list[int]:
    """Select the frames of a replay, increasing: the last one, every `spacing`-th before it, and the first one."""
    return sorted({0, *range(len(execution.trajectory) - 1, -1, -spacing)})


CAMERA_PLACE = 45.0
"""Arc length of the place that every camera shows, m; chosen: a third of a usual road."""
SIZE = (240, 120)
"""Columns and rows of a drive's picture; chosen: half of the network's input, the size at which it is displayed."""
QUALITY = 60
"""Quality of the JPEGs; chosen: 3 kB each, lines without visible fringes."""
_CAMERA_STEPS = 600
_THREADS = 2


@dataclass(frozen=True, kw_only=True)
class CameraPicture:
    """Camera picture of one simulator, a PNG as data URI, and the place of the vehicle, or why there is none."""

    simulator: SimulatorName
    physics: str = ""
    picture: str = ""
    note: str


@dataclass(frozen=True, kw_only=True)
class PicturedDrive:
    """Pictures of one drive: base64 of a JPEG and caption of each, times in s, indices of the strip, or why none."""

    frames: tuple[tuple[str, str], ...] = ()
    times: tuple[float, ...] = ()
    strip: tuple[int, ...] = ()
    note: str = ""


def translates(driver: DriverName) -> bool:
    """Return whether a driver sees translated images, and its generators are there."""
    try:
        return generators_of(driver) is not None
    except ValueError:  # missing generators must not prevent the report
        return False


def _paired(image: NDArray[np.uint8], driver: DriverName, simulator: SimulatorName) -> NDArray[np.uint8]:
    """Put the image that the driver sees below the camera's, if it sees another one."""
    translate = translation_of(driver, simulator) if translates(driver) else None
    return image if translate is None else np.vstack((image, translate(image)))


def camera_picture(
    name: SimulatorName, scenario: Scenario, trusted: Collection[str] = (), driver: DriverName = AUTOPILOT
) -> CameraPicture:
    """Render a place of a road on a simulator, driven by the autopilot; below it what a driver sees."""
    try:
        with closing(make_simulator(received_simulator(name, confirmed=trusted))) as simulator:
            reached = _drive_to(simulator, scenario)
            physics = simulator.spec.physics
            image = _paired(reached.image, driver, name)
    except Exception as error:  # a missing or broken simulator must not prevent the report
        return CameraPicture(simulator=name, note=f"no picture: {' '.join(str(error).split())}")
    lateral = reached.lane.lateral_position
    side = "right" if lateral >= 0 else "left"
    note = (
        f"{reached.lane.arc_length:.1f} m along the lane, {abs(lateral):.2f} m to the {side} of its centre, "
        f"{3.6 * reached.vehicle.speed:.0f} km/h"
    )
    if reached.lane.arc_length < CAMERA_PLACE:
        note += f"; the autopilot got no further ({reached.outcome.words})"
    return CameraPicture(simulator=name, physics=physics, picture=data_address(image), note=note)


def _drive_to(simulator: Simulator, scenario: Scenario) -> Observation:
    """Drive to `CAMERA_PLACE`; return the first observation there, or the last one before it."""
    latest = simulator.load(scenario.road, seed=scenario.seed, conditions=scenario.conditions)
    autopilot = Autopilot(simulator.spec.autopilot)
    for _ in range(_CAMERA_STEPS):
        if latest.lane.arc_length >= CAMERA_PLACE or latest.outcome is not Outcome.RUNNING:
            break
        latest = simulator.step(autopilot.command(latest.lane.preview_lateral_position, latest.vehicle.speed))
    return latest


def drive_pictures(
    names: Sequence[SimulatorName],
    tests: Sequence[Test],
    executions: Sequence[Execution],
    trusted: Collection[str] = (),
    driver: DriverName = AUTOPILOT,
    *,
    frames: Mapping[tuple[str, SimulatorName], Sequence[int]],
    one_by_one: bool = False,
) -> dict[str, list[PicturedDrive | None]]:
    """Render drives, with what the driver sees, as `plan_pictures` chose their frames; `one_by_one` takes less memory.

    Returns:
        Test -> drive on every simulator, or None if no picture is wanted there; tests without any are left out.
    """
    cv2.setNumThreads(1)

    def on(name: SimulatorName) -> dict[str, PicturedDrive]:
        drives = {e.test_id: e for e in executions if e.simulator == name and (e.test_id, name) in frames}
        if not drives:
            return {}
        simulator = trusted_simulator(name, trusted)
        if isinstance(simulator, str):
            return dict.fromkeys(drives, PicturedDrive(note=f"no pictures: {simulator}"))
        with closing(simulator):
            return {
                one.test_id: render_drive(simulator, one, drives[one.test_id], frames[one.test_id, name], driver)
                for one in tests
                if one.test_id in drives
            }

    with ThreadPoolExecutor(1 if one_by_one else _THREADS) as pool:
        # A thread for each simulator: some renderers belong to one thread at a time.
        columns = list(pool.map(on, names))
    shown = [test.test_id for test in tests if any((test.test_id, name) in frames for name in names)]
    return {test_id: [column.get(test_id) for column in columns] for test_id in shown}


def trusted_simulator(name: SimulatorName, trusted: Collection[str]) -> Simulator | str:
    """Make a simulator, or say why there is none: it must not prevent a page."""
    try:
        return make_simulator(received_simulator(name, confirmed=trusted))
    except Exception as error:  # whatever code of others raises
        return " ".join(str(error).split())


def render_drive(
    simulator: Simulator, test: Test, execution: Execution, steps: Sequence[int], driver: DriverName
) -> PicturedDrive:
    """Render increasing frames of one drive, with what the driver sees, on a simulator that drives nothing now."""
    see = partial(_paired, driver=driver, simulator=execution.simulator)
    if not isinstance(simulator, RoadSimulator):
        return PicturedDrive(note="no pictures: this simulator renders images only while it drives")
    try:
        scene = simulator.scene
        scene.load(test.road, np.random.default_rng(test.seed), test.conditions.for_scene(scene.conditions))
        frames = [_frame(simulator.scene, test, execution, k, see) for k in steps]
    except Exception as error:  # as above
        return PicturedDrive(note=f"no pictures: {' '.join(str(error).split())}")
    strip = set(moments(execution))
    return PicturedDrive(
        frames=tuple(frames),
        times=tuple(round(step / FRAME_RATE, 2) for step in steps),
        strip=tuple(index for index, step in enumerate(steps) if step in strip),
    )


def _frame(scene: Scene, test: Test, execution: Execution, step: int, see: Translation) -> tuple[str, str]:
    """Render one frame, with noise only under conditions, which may change it, and write its caption."""
    x, y, yaw, speed, lateral = (float(v) for v in execution.trajectory[step])
    before = float(execution.trajectory[max(step - 1, 0), 2])
    turned = float(np.angle(np.exp(1j * (yaw - before))))
    state = VehicleState(x=x, y=y, yaw=yaw, speed=speed, yaw_rate=turned * FRAME_RATE, steering_angle=0.0)
    image = scene.still(state, None if test.conditions.is_default else np.random.default_rng([test.seed, step]))
    side = "right" if lateral >= 0 else "left"
    return _jpeg(see(image)), f"{step / FRAME_RATE:.1f} s, {abs(lateral):.2f} m {side}, {3.6 * speed:.0f} km/h"


def _jpeg(image: NDArray[np.uint8]) -> str:
    columns, rows = SIZE
    size = (columns, rows * len(image) // IMAGE_HEIGHT)
    small = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    return base64.b64encode(jpeg(small, QUALITY)).decode()
