"""Another ROS 2 simulator as a sibling: drives, same bytes, and one line whatever it does wrong."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from ds_driver.closed_loop.simulation import drive_road, make_driver
from ds_driver.processes import ChildProcesses
from ds_road import Road
from ds_sim.registry import make_simulator
from ds_sim.session import RunRecord
from ds_sim.simulator import Command, Observation, Outcome
from ds_sim.testing import CHECKS, STRAIGHT, digest, drive, reference_driver, run_check

pytestmark = pytest.mark.graph

PROGRAM = Path(__file__).with_name("foreign_simulator.py")
BENDS = Road([(125, 25), (125, 40), (127, 55), (130, 69), (132, 84), (132, 100)])
"""Of 45 m, to the right and back."""
TIMEOUT = 1.5
"""Limit of every wait, s; chosen: starved processors delay an answer by tenths of a second."""
DESCRIPTION = """
name: foreign
vehicle: {{length: 4.0, width: 1.8, wheelbase: 2.6, max_steering_angle: 0.5}}
image: /car/camera
odometry: /car/odom
command: {{topic: /car/cmd, type: {command}}}
road: {{service: /load_road}}
reset: /reset
time: {time}
timeout: {timeout}
"""
LOCK_STEP = "{step: /step_simulation, seconds: 0.01}"
SHORT = (
    "noise_follows_the_seed", "left_is_left", "run_begins_at_rest", "the_left_lane_is_driven",
    "leaving_the_lane_ends_the_run", "image_has_the_right_type", "image_shows_the_scene", "drawn_rows_are_the_same",
    "stills_change_nothing", "bad_input_is_refused",
)  # fmt: skip
"""Checks of a second or two; none is left out for what the simulator is, the others are `long`."""
Start = Callable[..., "subprocess.Popen[bytes]"]


@pytest.fixture(scope="module")
def domain() -> Iterator[None]:
    """A ROS domain that this test's processes have for themselves."""
    from ds_orchestrator.graph.session import RosDomain

    reserved = RosDomain()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(reserved.number))
        yield
    reserved.close()


@pytest.fixture(scope="module")
def start(domain: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Start]:
    children, folder = ChildProcesses(), tmp_path_factory.mktemp("foreign")

    def started(*options: str) -> subprocess.Popen[bytes]:
        log = folder / f"{time.monotonic_ns()}.log"
        process = children.start([sys.executable, str(PROGRAM), *options], environment=os.environ, log=log)
        deadline = time.monotonic() + 30.0
        while b"ready" not in log.read_bytes():
            assert process.poll() is None and time.monotonic() < deadline, log.read_text()
            time.sleep(0.02)
        return process

    yield started
    children.close()


def described(folder: Path, *, time: str = LOCK_STEP, command: str = "twist", timeout: float = TIMEOUT) -> str:
    path = folder / "foreign.yaml"
    path.write_text(DESCRIPTION.format(time=time, command=command, timeout=timeout))
    return f"ros@{path}"


@pytest.fixture(scope="module")
def foreign(start: Start, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A simulator in lock-step; yields the sibling's name."""
    process = start()
    yield described(tmp_path_factory.mktemp("description"), timeout=5.0)
    end(process)


@pytest.fixture
def alone(start: Start, monkeypatch: pytest.MonkeyPatch) -> Iterator[Start]:
    """Starts simulators that a test ends or breaks, in a domain of their own."""
    from ds_orchestrator.graph.session import RosDomain

    reserved, processes = RosDomain(), []
    monkeypatch.setenv("ROS_DOMAIN_ID", str(reserved.number))

    def started(*options: str) -> subprocess.Popen[bytes]:
        processes.append(start(*options))
        return processes[-1]

    yield started
    for process in processes:
        end(process)
    reserved.close()


def end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()


def driven(name: str, road: Road = BENDS, act: Callable[[], None] | None = None) -> RunRecord:
    """Drive a road with the autopilot; `act` is called in frame 10."""
    simulator = make_simulator(name)
    pilot = make_driver("autopilot", simulator.spec)

    def command(seen: Observation) -> Command:
        if seen.step == 10 and act is not None:
            act()
        return pilot(seen)

    try:
        return drive_road(simulator, command, road, 1)
    finally:
        simulator.close()


def test_the_autopilot_completes_a_road_and_a_run_repeats_its_bytes(foreign: str) -> None:
    simulator = make_simulator(foreign)
    first = drive(simulator, BENDS, make_driver("autopilot", simulator.spec))
    drive(simulator, STRAIGHT, lambda seen: Command(0.4, 1.0), steps=20)
    again = drive(simulator, BENDS, make_driver("autopilot", simulator.spec))
    simulator.close()
    assert first[-1].outcome is Outcome.COMPLETED and digest(first) == digest(again)
    assert max(abs(seen.lane.lateral_position) for seen in first) < 1.0


@pytest.mark.parametrize("check", [c if c in SHORT else pytest.param(c, marks=pytest.mark.long) for c in CHECKS])
def test_it_promises_what_every_simulator_does(foreign: str, check: str) -> None:
    run_check(check, foreign)


def test_a_vehicle_has_one_driver_at_a_time(foreign: str) -> None:
    one, other = make_simulator(foreign), make_simulator(foreign)
    one.load(STRAIGHT, seed=1)
    run = drive_road(other, lambda seen: Command(0.0, 0.0), STRAIGHT, 1)
    one.close()
    other.close()
    assert run.outcome is Outcome.SIM_ERROR
    assert "foreign: another run drives this simulator, which has one vehicle: drive one road at a time" in run.message


def test_a_command_that_nobody_takes_is_one_line(foreign: str, tmp_path: Path) -> None:
    run = driven(described(tmp_path, command="twist_stamped"))
    assert "command of the type geometry_msgs/msg/TwistStamped" in run.message
    assert "geometry_msgs/msg/Twist" in run.message and "\n" not in run.message


def test_the_graph_of_the_command_line_drives_it(foreign: str, tmp_path: Path) -> None:
    """The graph of the command line has a ROS domain of its own; the simulator is looked for in the user's."""
    from ds_orchestrator.graph.session import running_graph

    with running_graph({foreign: "/ds1"}, "autopilot", command_timeout=10.0, logs=tmp_path) as executor:
        run = executor.execute(foreign, BENDS, 1)
    assert run.outcome is Outcome.COMPLETED, run.message


def test_a_killed_simulator_ends_one_drive_and_the_next_finds_the_new_one(alone: Start, tmp_path: Path) -> None:
    process, name = alone(), described(tmp_path)
    simulator = make_simulator(name)
    pilot = reference_driver(simulator.spec.autopilot)

    def command(seen: Observation) -> Command:
        if seen.step == 10:
            end(process)
        return pilot(seen)

    run = drive_road(simulator, command, BENDS, 1)
    assert (run.outcome, run.steps) == (Outcome.SIM_ERROR, 10)
    assert "within 1.5 s" in run.message and "\n" not in run.message
    absent = drive_road(simulator, pilot, BENDS, 1)
    assert absent.outcome is Outcome.SIM_ERROR and "start the simulator in this ROS domain (" in absent.message
    alone()
    assert drive(simulator, BENDS, pilot, steps=20)[-1].outcome is Outcome.RUNNING
    simulator.close()


def test_a_frozen_simulator_ends_the_drive_within_the_limit(alone: Start, tmp_path: Path) -> None:
    process, frozen = alone(), []

    def freeze() -> None:
        process.send_signal(signal.SIGSTOP)
        frozen.append(time.monotonic())

    run = driven(described(tmp_path), act=freeze)
    assert run.outcome is Outcome.SIM_ERROR and "within 1.5 s" in run.message
    assert time.monotonic() - frozen[0] < 2 * TIMEOUT + 3.0


@pytest.mark.parametrize(
    ("fault", "line"),
    [
        ("nan", "foreign: /car/odom: position.x is nan, expected a finite number: the simulator diverged"),
        ("encoding", "foreign: /car/camera: image of encoding '32FC1', expected one of "),
        ("stamps", "foreign: /car/odom: no message stamped 0.045 s or later within 1.5 s, the newest has 0.000 s"),
    ],
)
def test_nonsense_is_one_line(alone: Start, tmp_path: Path, fault: str, line: str) -> None:
    alone("--fault", fault)
    run = driven(described(tmp_path))
    assert run.outcome is Outcome.SIM_ERROR
    assert line in run.message and "\n" not in run.message


def test_real_time_drives_and_says_what_it_saw(alone: Start, tmp_path: Path) -> None:
    alone("--realtime")
    simulator = make_simulator(described(tmp_path, time="realtime"))
    assert simulator.spec.extra["time"] == "real time: runs are not deterministic"
    seen = drive(simulator, STRAIGHT, reference_driver(simulator.spec.autopilot), steps=40)
    assert "frames up to" in simulator.spec.extra["latency"]
    simulator.close()
    assert seen[-1].step == 40 and seen[-1].vehicle.speed > 2.0 and abs(seen[-1].lane.lateral_position) < 0.5
