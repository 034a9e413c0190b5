"""Camera pictures of a report: one place as every simulator shows it, and the drives that tell most, moment by moment.

Drives are drawn again, from the recorded path by the library's own camera: no bag and no physics is needed. What the
store does not keep, the body's roll, pitch and heave, is 0 in them.
"""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_driver.control.autopilot import Autopilot
from ds_orchestrator.report.page_data import in_words
from ds_orchestrator.search.features import Cell
from ds_orchestrator.store.store import Execution, Test
from ds_sim.camera.ground import Ground, paint_ground
from ds_sim.camera.png import png
from ds_sim.camera.renderer import Camera, Sensor
from ds_sim.registry import make_simulator, received_simulator, spec_of
from ds_sim.simulator import FRAME_RATE, Observation, Outcome, Simulator, SimulatorSpec, VehicleState

CAMERA_PLACE = 45.0
"""m along the lane where the cameras' pictures are taken; chosen: past the start, a third of a usual road."""
DRIVEN_TESTS = 24
"""Tests whose drives are shown at most; chosen: 1.5 MB, and a quarter of a minute to draw them on two cores."""
MOMENTS = 5
"""Pictures of one drive; chosen: a row of them fits on a screen."""
BEFORE_FAILURE = 1.0
"""s between the pictures of a drive that failed, the last of which shows the failure; chosen: the car is seen to
leave, with the bend that it leaves in."""
SIZE = (240, 120)
"""Columns and rows of a drive's picture; chosen: half of what the network sees, as large as it is shown."""
QUALITY = 60
"""Of the JPEGs; chosen: 3 kB each, and lines without visible fringes."""
_CAMERA_STEPS = 600
_THREADS = 2


@dataclass(frozen=True, kw_only=True)
class CameraPicture:
    """What one simulator's camera sees.

    Attributes:
        simulator: its name.
        physics: one line on its physics model, or "".
        picture: PNG as data URI, or "" if there is none.
        note: where the vehicle is, or why there is no picture.
    """

    simulator: str
    physics: str = ""
    picture: str = ""
    note: str


@dataclass(frozen=True, kw_only=True)
class Drive:
    """Pictures of one drive.

    Attributes:
        frames: base64 of a JPEG, and one line on the moment, in order of time.
        note: why there are none, or "".
    """

    frames: tuple[tuple[str, str], ...] = ()
    note: str = ""


def common_test(tests: Sequence[Test], executions: Sequence[Execution]) -> Test | None:
    """The test that was completed on most simulators; the first one among equals."""
    completed = Counter(e.test_id for e in executions if e.outcome is Outcome.COMPLETED)
    return max(tests, key=lambda test: completed[test.test_id], default=None)


def camera_pictures(names: Sequence[str], test: Test, trusted: Collection[str] = ()) -> list[CameraPicture]:
    """The same place of the same road as every simulator shows it, with the autopilot at the wheel."""
    return [_camera_picture(name, test, trusted) for name in names]


def _camera_picture(name: str, test: Test, trusted: Collection[str]) -> CameraPicture:
    try:
        simulator = make_simulator(received_simulator(name, confirmed=trusted, option="--trust"))
        try:
            seen = _drive_to(simulator, test, CAMERA_PLACE)
            physics = simulator.spec.physics
        finally:
            simulator.close()
    except Exception as error:  # a simulator that is not installed or breaks must not cost the report
        return CameraPicture(simulator=name, note=f"no picture: {' '.join(str(error).split())}")
    note = (
        f"{seen.lane.arc_length:.1f} m along the lane, {_side(seen.lane.lateral_position)} of its centre, "
        f"{3.6 * seen.vehicle.speed:.0f} km/h"
    )
    if seen.lane.arc_length < CAMERA_PLACE:
        note += f"; the autopilot got no further ({in_words(seen.outcome)})"
    picture = f"data:image/png;base64,{base64.b64encode(png(seen.image)).decode()}"
    return CameraPicture(simulator=name, physics=physics, picture=picture, note=note)


def _drive_to(simulator: Simulator, test: Test, place: float) -> Observation:
    """The first observation at a place of the lane, or the last one before it."""
    seen = simulator.load(test.road, seed=test.seed)
    autopilot = Autopilot(simulator.spec.autopilot)
    for _ in range(_CAMERA_STEPS):
        if seen.lane.arc_length >= place or seen.outcome is not Outcome.RUNNING:
            break
        seen = simulator.step(autopilot.command(seen.lane.preview_lateral_position, seen.vehicle.speed))
    return seen


def _side(lateral_position: float) -> str:
    """`0.42 m to the right`."""
    return f"{abs(lateral_position):.2f} m to the {'right' if lateral_position >= 0 else 'left'}"


def telling_tests(
    tests: Sequence[Test], executions: Sequence[Execution], cells: Mapping[str, Cell], *, most: int = DRIVEN_TESTS
) -> list[Test]:
    """The tests that tell most, in the campaign's order: the worst of every cell first, then all that failed.

    Worse is what fails on more simulators, then what comes nearer to the lane's edge on any.
    """
    failures = Counter(e.test_id for e in executions if e.outcome.is_failure)
    nearest: dict[str, float] = {}
    for execution in executions:
        nearest[execution.test_id] = min(nearest.get(execution.test_id, np.inf), execution.fitness)
    driven = [test for test in tests if test.test_id in nearest and test.test_id in cells]
    driven.sort(key=lambda test: (-failures[test.test_id], nearest[test.test_id], test.test_id))
    worst: dict[Cell, str] = {}
    for test in driven:
        worst.setdefault(cells[test.test_id], test.test_id)
    failed = [test.test_id for test in driven if failures[test.test_id]]
    chosen = set(list(dict.fromkeys([*worst.values(), *failed]))[:most])
    return [test for test in tests if test.test_id in chosen]


def drive_pictures(
    names: Sequence[str], tests: Sequence[Test], executions: Sequence[Execution], trusted: Collection[str] = ()
) -> dict[str, list[Drive | None]]:
    """Test -> its drive on every simulator, or None where there was none."""
    done = {(e.test_id, e.simulator): e for e in executions}
    wanted = [(test, name, done.get((test.test_id, name))) for test in tests for name in names]
    cv2.setNumThreads(1)
    with ThreadPoolExecutor(_THREADS) as pool:
        drives = list(pool.map(lambda one: None if one[2] is None else _drive(one[1], one[0], one[2], trusted), wanted))
    rows = [drives[k : k + len(names)] for k in range(0, len(drives), len(names))]
    return {test.test_id: row for test, row in zip(tests, rows, strict=True)}


def _drive(name: str, test: Test, execution: Execution, trusted: Collection[str]) -> Drive:
    try:
        spec = spec_of(received_simulator(name, confirmed=trusted, option="--trust"))
        ground = paint_ground(test.road, spec.look)
        camera = Camera(spec.camera, spec.look)
        frames = [_frame(spec, camera, ground, test.seed, execution, k) for k in moments(execution)]
    except Exception as error:  # as for the cameras above
        return Drive(note=f"no pictures: {' '.join(str(error).split())}")
    return Drive(frames=tuple(frames))


def moments(execution: Execution) -> list[int]:
    """Frames of a drive that are shown, increasing: its last seconds if it failed, else all of it evenly."""
    last = len(execution.trajectory) - 1
    if last < 0:
        return []
    first = max(0, last - round(BEFORE_FAILURE * FRAME_RATE) * (MOMENTS - 1)) if execution.outcome.is_failure else 0
    return [int(k) for k in np.unique(np.linspace(first, last, MOMENTS).round().astype(int))]


def _frame(
    spec: SimulatorSpec, camera: Camera, ground: Ground, seed: int, execution: Execution, step: int
) -> tuple[str, str]:
    """One moment: the picture, and one line on it."""
    x, y, yaw, speed, lateral = (float(v) for v in execution.trajectory[step])
    before = float(execution.trajectory[max(step - 1, 0), 2])
    turned = float(np.angle(np.exp(1j * (yaw - before))))
    state = VehicleState(x=x, y=y, yaw=yaw, speed=speed, yaw_rate=turned * FRAME_RATE, steering_angle=0.0)
    # A sensor of its own for every picture: moments far apart know nothing of each other.
    sensor = Sensor(replace(spec.camera, latency=0), np.random.default_rng([seed, step]))
    image = sensor.deliver(camera.render(ground, state))
    side = "right" if lateral >= 0 else "left"
    return _jpeg(image), f"{step / FRAME_RATE:.1f} s, {abs(lateral):.2f} m {side}, {3.6 * speed:.0f} km/h"


def _jpeg(image: NDArray[np.uint8]) -> str:
    small = cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA)
    done, data = cv2.imencode(".jpg", cv2.cvtColor(small, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    assert done
    return base64.b64encode(data.tobytes()).decode()
