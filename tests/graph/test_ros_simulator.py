# SPDX-License-Identifier: Apache-2.0
"""Another ROS 2 simulator as a sibling: drives, same bytes, and one line whatever it does wrong."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import simulation_interfaces
import yaml
from tests.waiting import wait_until

from ds_base.processes import ChildProcesses
from ds_driver.closed_loop.simulation import drive_road, make_driver
from ds_driver.networks.driver_name import AUTOPILOT
from ds_orchestrator.graph.session import RosDomain, running_graph
from ds_road import Road
from ds_sim.registry import SimulatorName, make_simulator
from ds_sim.scenario import Scenario
from ds_sim.session import RunRecord
from ds_sim.simulator import Command, Observation, Outcome, Simulator
from ds_sim.testing import CHECKS, STRAIGHT, digest, drive, reference_driver, run_check

pytestmark = pytest.mark.graph

PROGRAM = Path("examples/ros_simulator.py")
FAULTY = Path(__file__).with_name("foreign_simulator.py")
DESCRIBED = yaml.safe_load(PROGRAM.with_suffix(".yaml").read_text())
BENDS = Road([(125, 25), (125, 40), (127, 55), (130, 69), (132, 84), (132, 100)])
"""Of 45 m, to the right and back."""
TIMEOUT = 1.5
"""Limit of every wait, s; chosen: starved processors delay an answer by tenths of a second."""
SHORT = (
    "left_is_left",
    "run_begins_at_rest",
    "the_left_lane_is_driven",
    "drawn_rows_are_the_same",
    "bad_input_is_refused",
)
"""Checks of a second or two; none is left out for what the simulator is, the others are `long`."""
CLIENT = """
import rclpy, rclpy.node
from ds_interfaces.srv import LoadRoad
from geometry_msgs.msg import Point
from simulation_interfaces.srv import GetSimulationState, ResetSimulation, StepSimulation
rclpy.init()
node = rclpy.node.Node("client")
def ask(kind, name, **fields):
    client = node.create_client(kind, "/other/" + name)
    assert client.wait_for_service(20.0)
    future = client.call_async(kind.Request(**fields))
    rclpy.spin_until_future_complete(node, future, timeout_sec=20.0)
    return future.result()
def state(): print(ask(GetSimulationState, "get_simulation_state").state.state)
def step(steps): print(ask(StepSimulation, "step_simulation", steps=steps).result.result)
state(); step(1)
road = LoadRoad.Request().road
road.control_points = [Point(x=125.0, y=25.0 * i) for i in range(1, 5)]
assert ask(LoadRoad, "load_road", road=road, seed=1).accepted
state(); step(3); state()
print(ask(ResetSimulation, "reset_simulation").result.result)
step(10**6); state()
"""
Start = Callable[..., "subprocess.Popen[bytes]"]
Sibling = Callable[..., Simulator]


@pytest.fixture(scope="module")
def domain() -> Iterator[None]:
    """A ROS domain that this test's processes have for themselves."""
    reserved = RosDomain()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(reserved.number))
        yield
    reserved.close()


@pytest.fixture(scope="module")
def start(domain: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Start]:
    children, folder = ChildProcesses(), tmp_path_factory.mktemp("foreign")

    def started(*options: str, program: Sequence[str] = (str(PROGRAM),), **more: str) -> subprocess.Popen[bytes]:
        log = folder / f"{time.monotonic_ns()}.log"
        process = children.start([sys.executable, *program, *options], environment=os.environ | more, log=log)
        wait_until(lambda: b"ready" in log.read_bytes() or process.poll() is not None)
        assert process.poll() is None, log.read_text()
        return process

    yield started
    children.close()


def described(folder: Path, *, timeout: float = TIMEOUT, **changes: Any) -> str:
    path = folder / "foreign.yaml"
    path.write_text(yaml.safe_dump(DESCRIBED | {"name": "foreign", "timeout": timeout} | changes))
    return f"ros@{path}"


@pytest.fixture(scope="module")
def foreign(start: Start, tmp_path_factory: pytest.TempPathFactory) -> Iterator[SimulatorName]:
    """A simulator in lock-step; yields the sibling's name."""
    process = start()
    yield SimulatorName(described(tmp_path_factory.mktemp("description"), timeout=5.0))
    end(process)


@pytest.fixture
def own_node(alone: Start) -> None:
    """A simulator's node of this project in the namespace /other."""
    alone(program=("-m", "ds_sim.ros.simulator_node", "--ros-args", "-r", "__ns:=/other", "-p", "simulator:=donkey"))


@pytest.fixture
def alone(start: Start, monkeypatch: pytest.MonkeyPatch) -> Iterator[Start]:
    """Starts simulators that a test ends or breaks, in a domain of their own."""
    reserved, processes = RosDomain(), []
    monkeypatch.setenv("ROS_DOMAIN_ID", str(reserved.number))

    def started(*options: str, **more: Any) -> subprocess.Popen[bytes]:
        processes.append(start(*options, **more))
        return processes[-1]

    yield started
    for process in processes:
        end(process)
    reserved.close()


@pytest.fixture
def sibling(tmp_path: Path) -> Iterator[Sibling]:
    """Makes simulators of descriptions with changes, and closes them."""
    with ExitStack() as stack:
        yield lambda **changes: stack.enter_context(closing(make_simulator(described(tmp_path, **changes))))


def end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()


def driven(simulator: Simulator, act: Callable[[], None] | None = None) -> RunRecord:
    """Drive the bends with the autopilot; `act` is called in frame 10."""
    pilot = make_driver("autopilot", simulator.spec)

    def command(seen: Observation) -> Command:
        if seen.step == 10 and act is not None:
            act()
        return pilot(seen)

    return drive_road(simulator, command, BENDS, 1)


def test_the_autopilot_completes_a_road_and_a_run_repeats_its_bytes(foreign: SimulatorName) -> None:
    simulator = make_simulator(foreign)
    first = drive(simulator, BENDS, make_driver("autopilot", simulator.spec))
    drive(simulator, STRAIGHT, lambda seen: Command(0.4, 1.0), steps=20)
    again = drive(simulator, BENDS, make_driver("autopilot", simulator.spec))
    simulator.close()
    assert first[-1].outcome is Outcome.COMPLETED and digest(first) == digest(again)
    assert max(abs(seen.lane.lateral_position) for seen in first) < 1.0


@pytest.mark.parametrize("check", [c if c in SHORT else pytest.param(c, marks=pytest.mark.long) for c in CHECKS])
def test_it_promises_what_every_simulator_does(foreign: SimulatorName, check: str) -> None:
    run_check(check, foreign)


def test_the_page_shows_the_example_that_runs() -> None:
    text = PROGRAM.with_suffix(".yaml").read_text()
    assert f"```yaml\n{text}```" in Path("docs/any_ros_simulator.md").read_text()


def test_a_vehicle_has_one_driver_at_a_time(foreign: SimulatorName) -> None:
    one, other = make_simulator(foreign), make_simulator(foreign)
    one.load(STRAIGHT, seed=1)
    run = drive_road(other, lambda seen: Command(0.0, 0.0), STRAIGHT, 1)
    one.close()
    other.close()
    assert run.outcome is Outcome.SIM_ERROR
    assert "foreign: another run drives this simulator, which has one vehicle: drive one road at a time" in run.message


def test_a_command_that_nobody_takes_is_one_line(foreign: SimulatorName, sibling: Sibling) -> None:
    run = driven(sibling(command={"topic": "/car/cmd", "type": "twist_stamped"}))
    assert "command of the type geometry_msgs/msg/TwistStamped" in run.message
    assert "geometry_msgs/msg/Twist" in run.message and "\n" not in run.message


def test_the_graph_of_the_command_line_drives_it(foreign: SimulatorName, tmp_path: Path) -> None:
    """The graph of the command line has a ROS domain of its own; the simulator is looked for in the user's."""
    with running_graph({foreign: "/ds1"}, AUTOPILOT, command_timeout=10.0, logs=tmp_path) as executor:
        run = executor.execute(foreign, Scenario(BENDS, seed=1))
    assert run.outcome is Outcome.COMPLETED, run.message


def test_a_killed_simulator_ends_one_drive_and_the_next_finds_the_new_one(alone: Start, sibling: Sibling) -> None:
    process, simulator = alone(), sibling()
    run = driven(simulator, act=lambda: end(process))
    assert (run.outcome, run.steps) == (Outcome.SIM_ERROR, 10)
    assert "within 1.5 s" in run.message and "\n" not in run.message
    absent = driven(simulator)
    assert absent.outcome is Outcome.SIM_ERROR and "start the simulator in this ROS domain (" in absent.message
    alone()
    pilot = reference_driver(simulator.spec.autopilot)
    assert drive(simulator, BENDS, pilot, steps=20)[-1].outcome is Outcome.RUNNING


def test_a_frozen_simulator_ends_the_drive_within_the_limit(alone: Start, sibling: Sibling) -> None:
    process, frozen = alone(), []

    def freeze() -> None:
        process.send_signal(signal.SIGSTOP)
        frozen.append(time.monotonic())

    run = driven(sibling(), act=freeze)
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
def test_nonsense_is_one_line(alone: Start, sibling: Sibling, fault: str, line: str) -> None:
    alone(program=[str(FAULTY)], FAULT=fault)
    run = driven(sibling())
    assert run.outcome is Outcome.SIM_ERROR
    assert line in run.message and "\n" not in run.message


def test_a_command_is_taken_before_its_step_whatever_the_executor_sees_first(alone: Start, sibling: Sibling) -> None:
    digests = []
    for fault in ("", "preempted"):
        process, simulator = alone(program=[str(FAULTY)], FAULT=fault), sibling()
        digests.append(digest(drive(simulator, BENDS, reference_driver(simulator.spec.autopilot), steps=60)))
        simulator.close()
        end(process)
    assert digests[0] == digests[1]


def test_a_road_is_written_before_it_is_reloaded(alone: Start, sibling: Sibling, tmp_path: Path) -> None:
    alone(program=[str(FAULTY)], ROAD=str(tmp_path / "road.json"))
    simulator = sibling(road={"file": "road.json", "reload": "/reload"}, reset=None)
    pilot = reference_driver(simulator.spec.autopilot)
    for road in (BENDS, STRAIGHT.in_lane("left")):
        seen = drive(simulator, road, pilot, steps=40)
        assert seen[-1].step == 40 and abs(seen[-1].lane.lateral_position) < 0.5 < seen[-1].vehicle.speed


def test_real_time_drives_and_says_what_it_saw(alone: Start, sibling: Sibling) -> None:
    alone("--realtime")
    simulator = sibling(time="realtime")
    assert simulator.spec.extra["time"] == "real time: runs are not deterministic"
    seen = drive(simulator, STRAIGHT, reference_driver(simulator.spec.autopilot), steps=40)
    assert "frames up to" in simulator.spec.extra["latency"]
    assert seen[-1].step == 40 and seen[-1].vehicle.speed > 2.0 and abs(seen[-1].lane.lateral_position) < 0.5


def test_a_simulator_of_this_project_behind_the_standard_is_the_same_simulator(
    own_node: None, sibling: Sibling
) -> None:
    """The oracle of the whole way: roads, resets, steps, commands and poses against the same physics without ROS."""
    topics = {"image": "/other/camera/image_raw", "odometry": "/other/odom", "road": {"service": "/other/load_road"}}
    changes: dict[str, Any] = {
        **topics,
        "command": {"topic": "/other/drive", "type": "drive_command"},
        "reset": "/other/reset_simulation",
        "time": {"step": "/other/step_simulation", "seconds": 0.05},
    }
    there = sibling(**changes)
    here = make_simulator("donkey")
    for lane in (BENDS, BENDS.in_lane("left")):
        runs = [drive_road(one, make_driver("autopilot", here.spec), lane, 1) for one in (here, there)]
        first, second = (
            [(seen.vehicle.x, seen.vehicle.y, seen.vehicle.yaw) for seen in run.observations] for run in runs
        )
        assert runs[0].outcome is runs[1].outcome is Outcome.COMPLETED
        assert np.allclose(first, second, rtol=0.0, atol=1e-9)
    here.close()


def test_the_services_answer_as_the_standard_has_it(own_node: None) -> None:
    """States and refusals of the node that is stepped, asked by a plain client."""
    client = subprocess.run([sys.executable, "-c", CLIENT], capture_output=True, text=True, timeout=60, check=True)
    assert client.stdout.split() == ["4", "3", "0", "1", "2", "1", "4", "0"], client.stderr


HASHES = {
    "StepSimulation": "913fe0653690ce6bf8f09f316e6a626747012e9fca31e26719910d417aa8565c",
    "ResetSimulation": "4ce285d7ff9b8ac70dcc95161f32bf54c05a6f4b13427990e41ab40c36c39646",
    "GetSimulatorFeatures": "abb9439c8cf196722a469fb6c68b44b484f198c2a1356ac38849a29c2a20a794",
    "GetSimulationState": "3362dcebee4b1afebbf9c4beee5c79c1455385aded62092a892d61fde8644f30",
}
"""Type hashes of simulation_interfaces 2.1.0, built from its own files."""


@pytest.mark.parametrize("name", HASHES)
def test_the_definitions_are_the_standards(name: str) -> None:
    share = Path(simulation_interfaces.__file__).parents[4] / "share/simulation_interfaces"
    described = json.loads((share / f"srv/{name}.json").read_text())["type_hashes"][0]
    assert described == {"type_name": f"simulation_interfaces/srv/{name}", "hash_string": f"RIHS01_{HASHES[name]}"}
