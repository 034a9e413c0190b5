# SPDX-License-Identifier: Apache-2.0
"""Nodes end within a second of a signal, whatever they are doing; a killed graph leaves nothing in shared memory."""

from __future__ import annotations

import ctypes
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest
import rclpy
from ament_index_python.packages import get_package_prefix
from ds_interfaces.action import RunCampaign
from rclpy.action import ActionClient
from rclpy.context import Context
from rclpy.node import Node
from tests.graph.processes import SHORT

from ds_orchestrator.graph.client import GraphClient
from ds_orchestrator.graph.session import RosDomain
from ds_sim.registry import DONKEY
from ds_sim.ros.node_thread import NodeThread
from ds_sim.ros.runtime import init_ros
from ds_sim.scenario import Scenario

pytestmark = pytest.mark.graph

LIBC = ctypes.CDLL(None)
SIGNALS = [signal.SIGINT, signal.SIGTERM]
SECOND = 1.0
"""Documented limit on a machine that is not overloaded, s; see `seconds_to_end`."""
Start = Callable[..., "subprocess.Popen[str]"]


def heed_signals() -> None:
    """Take back what a shell's background job or `nohup` hands down: signals that are ignored. End with the tests."""
    LIBC.prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG; a killed pytest leaves no orchestrator in a domain
    for number in (*SIGNALS, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


def in_domain(command: list[str | Path], domain: int) -> subprocess.Popen[str]:
    here = os.pathsep.join([str(Path.cwd()), os.environ.get("PYTHONPATH", "")])  # for this project's tests.*
    return subprocess.Popen(
        command,
        env=os.environ | {"ROS_DOMAIN_ID": str(domain), "PYTHONUNBUFFERED": "1", "PYTHONPATH": here},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
        preexec_fn=heed_signals,
    )


@pytest.fixture
def start() -> Iterator[Start]:
    """Start a package's executable in a domain, as `ros2 run` does."""
    processes = []

    def begin(executable: str, domain: int, *arguments: str) -> subprocess.Popen[str]:
        package, name = executable.split("/")
        program = Path(get_package_prefix(package)) / "lib" / package / name
        processes.append(in_domain([program, "--ros-args", *arguments], domain))
        return processes[-1]

    yield begin
    for process in processes:
        process.kill()
        process.wait()


@pytest.fixture
def domain() -> Iterator[int]:
    held = RosDomain()
    yield held.number
    held.close()


def read_until(process: subprocess.Popen[str], text: str) -> None:
    assert process.stdout is not None
    while text not in (line := process.stdout.readline()):
        assert line, f"{text!r} was never written"


def seconds_to_end(process: subprocess.Popen[str], number: signal.Signals) -> float:
    """Send a signal and wait; no traceback may be written.

    Returns:
        Seconds until the process has ended, divided by the number of runnable processes per core where it exceeds 1:
        the other tests and their nodes run at the same time.
    """
    began = time.monotonic()
    process.send_signal(number)
    crowd = runnable()
    written, _ = process.communicate(timeout=60.0)
    seconds = time.monotonic() - began
    assert "Traceback" not in written, written
    return seconds / max(1.0, max(crowd, runnable()) / len(os.sched_getaffinity(0)))


def processor_time(pid: int) -> float:
    """Read the CPU time of a process, s, which measures its progress on a busy machine too."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, fields[11:13])) / os.sysconf("SC_CLK_TCK")


def catches(pid: int, number: signal.Signals) -> bool:
    """Whether a process has a handler for a signal (proc(5): `SigCgt`)."""
    status = Path(f"/proc/{pid}/status").read_text()
    return bool(int(status.partition("SigCgt:")[2].split()[0], 16) >> (number - 1) & 1)


def runnable() -> float:
    """Count processes that run or wait for a core: the average of the last minute, or the current number if higher."""
    average, _, _, now, _ = Path("/proc/loadavg").read_text().split()
    return max(float(average), float(now.partition("/")[0]))


@pytest.mark.parametrize(("number", "after"), [(signal.SIGINT, 0.0), (signal.SIGTERM, 0.5), (signal.SIGINT, 1.2)])
def test_a_node_ends_during_its_set_up(start: Start, domain: int, number: signal.Signals, after: float) -> None:
    """As soon as our first lines have run, while PyTorch is imported, while the network is loaded; in s of CPU time."""
    process = start("ds_driver/driver", domain)
    # Before, Python has its own handlers; how long it takes to start depends on the machine.
    while not catches(process.pid, signal.SIGTERM):
        assert process.poll() is None
        time.sleep(0.002)
    used, since = processor_time(process.pid), time.monotonic()
    after += used
    # A fast machine is ready before; then the processor time stands still.
    while used < after and time.monotonic() < since + 1.0:
        time.sleep(0.005)
        if (now := processor_time(process.pid)) > used:
            used, since = now, time.monotonic()
    assert seconds_to_end(process, number) < SECOND


@pytest.mark.parametrize("name", ["campaign", "orchestrator"])
def test_a_command_that_a_signal_stops_twice_is_no_error(start: Start, domain: int, tmp_path: Path, name: str) -> None:
    """As `ros2 launch` does, which repeats the terminal's Ctrl-C, and calls any status but 0 an error."""
    given = {"campaign": ("--", "src/ds_bringup/config/demo.yaml", "--out", str(tmp_path / "c"))}
    process = start(f"ds_orchestrator/{name}", domain, *given.get(name, ()))
    while not catches(process.pid, signal.SIGHUP):  # of the signals, the last one that these take over
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    seconds_to_end(process, signal.SIGINT)
    assert process.returncode == 0


BUSY = """
import threading, time
from ds_studies.ros import orchestrator_node as node
def keep_busy(job, trusted):
    print("busy", flush=True)
    while True:
        try:
            time.sleep(60.0)
        except KeyboardInterrupt:
            print("goes on", flush=True)
node.run_campaign_goal = keep_busy
node.main()
"""


def test_the_orchestrator_ends_within_5_s_whatever_it_does(domain: int) -> None:
    """Also while it drives for a goal whose engine does not end, and the client gets its result."""
    process = in_domain([sys.executable, "-c", BUSY], domain)
    rclpy.init(domain_id=domain)
    try:
        asker = Node("asker")
        client = ActionClient(asker, RunCampaign, "run_campaign")
        assert client.wait_for_server(60.0)
        handle = client.send_goal_async(RunCampaign.Goal(folder="c"))
        rclpy.spin_until_future_complete(asker, handle, timeout_sec=20.0)
        read_until(process, "busy")
        result = handle.result().get_result_async()  # type: ignore[union-attr]
        process.send_signal(signal.SIGINT)
        began, crowd = time.monotonic(), runnable()
        rclpy.spin_until_future_complete(asker, result, timeout_sec=20.0)
        assert "a signal ended the node" in result.result().result.message  # type: ignore[union-attr]
        assert process.wait(20.0) == 0
        crowd = max(crowd, runnable()) / len(os.sched_getaffinity(0))
        assert time.monotonic() - began < 5.0 * max(1.0, crowd)
    finally:
        process.kill()
        rclpy.try_shutdown()


@pytest.mark.parametrize(
    ("number", "executable", "ready"),
    [
        (signal.SIGINT, "ds_sim/simulator", "is ready"),
        (signal.SIGTERM, "ds_driver/autopilot", "drives"),
        (signal.SIGTERM, "ds_driver/closed_loop", "drives"),
        (signal.SIGINT, "ds_driver/cmd_vel_adapter", "drives"),
    ],
)
def test_a_node_that_waits_ends(start: Start, domain: int, number: signal.Signals, executable: str, ready: str) -> None:
    """Also with simulated time that is not published."""
    process = start(executable, domain, "-p", "use_sim_time:=true")
    read_until(process, ready)
    assert seconds_to_end(process, number) < SECOND
    assert process.returncode == 0


HANGING = "tests.engines.quick_simulator:HangingSimulator"


@pytest.mark.parametrize(("number", "simulator"), [(signal.SIGINT, "donkey"), (signal.SIGTERM, HANGING)])
def test_a_node_ends_in_the_midst_of_a_run(
    start: Start, domain: int, number: signal.Signals, simulator: str, logs: Path
) -> None:
    """A healthy one at full speed, and one that hangs in its physics."""
    process = start("ds_sim/simulator", domain, "-p", f"simulator:={simulator}", "-r", "__ns:=/a/b")
    driver = start("ds_driver/autopilot", domain, "-r", "__ns:=/a/b")
    read_until(process, "is ready")
    read_until(driver, "drives")
    executor = GraphClient({DONKEY: "/a/b"}, domain=domain, command_timeout=20.0)
    try:
        executor.wait_until_ready(30.0)
        threading.Thread(target=executor.execute, args=("donkey", Scenario(SHORT, seed=1)), daemon=True).start()
        if simulator == HANGING:
            read_until(process, "hangs")
        else:
            time.sleep(0.5)
        assert seconds_to_end(process, number) < SECOND
        assert seconds_to_end(driver, number) < SECOND
    finally:
        executor.close()


def test_an_exception_in_a_task_ends_in_the_log(domain: int, capfd: pytest.CaptureFixture[str]) -> None:
    """ros2/rclpy issue 1641: without care the process ends with a segmentation fault."""
    context = Context()
    init_ros(context=context, domain_id=domain)
    node = Node("spun", context=context)

    def refuse() -> None:
        raise RuntimeError("two servers accepted the goal")

    thread = NodeThread(node)
    assert thread.call(refuse, 5.0) is None
    spun = threading.Event()
    assert thread.call(lambda: spun.set(), 5.0) is None and spun.is_set()  # type: ignore[arg-type,func-returns-value]
    assert thread.end()
    node.destroy_node()
    context.shutdown()
    sys.stdout.flush()
    assert "RuntimeError: two servers accepted the goal" in capfd.readouterr().err


PROFILE = Path.cwd() / "src/ds_bringup/config/fastdds_loopback.xml"
LIMIT = 60.0
"""Longest wait for a graph, s."""
NODE = """
from ds_sim.ros.runtime import init_ros
init_ros()
from rclpy.node import Node
from tests.graph.processes import SHORT
node = Node("node")
print(*(line for line in open("/proc/self/maps") if "/dev/shm/fastrtps" in line))
"""


@pytest.fixture
def road(tmp_path: Path) -> Path:
    path = tmp_path / "road.json"
    path.write_text(json.dumps([(125.0, 25.0 * i) for i in range(4)]))
    return path


def drive(road: Path, **environment: str) -> subprocess.Popen[str]:
    command = ["drive", "--sim", "donkey", "--driver", "autopilot", "--road", str(road), "--json"]
    return subprocess.Popen(
        [sys.executable, "-m", "ds_cli.main", *command],
        env=os.environ | environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def read_each(pid: int, pattern: str, read: Callable[[Path], str] = Path.read_text) -> Iterator[str]:
    """Read what a process has in /proc, without what ends between listing and reading: threads and open files do."""
    for path in Path(f"/proc/{pid}").glob(pattern):
        with suppress(FileNotFoundError, ProcessLookupError):
            yield read(path)


def children(pid: int) -> list[int]:
    """List the child processes of a process, whichever of its threads started them."""
    return [int(child) for text in read_each(pid, "task/*/children") for child in text.split()]


def dds_transports(pid: int) -> set[str]:
    """Name the transports of Fast DDS in a process, `udp` or `shm`, by the threads that receive."""
    names = read_each(pid, "task/*/comm")
    return {name.split(".")[1] for name in names if name.startswith(("dds.udp", "dds.shm"))}


def shared_memory(pid: int) -> list[str]:
    """List the files of Fast DDS in shared memory that a process maps or has open."""
    links = list(read_each(pid, "fd/*", os.readlink))
    lines = Path(f"/proc/{pid}/maps").read_text().splitlines()
    return [name for name in links + lines if "/dev/shm/" in name and "fastrtps" in name]


def test_a_killed_graph_leaves_nothing(road: Path) -> None:
    """What a process leaves in shared memory when it is killed, it has mapped or open before."""
    killed, deadline = drive(road), time.monotonic() + LIMIT
    graph, transports = [killed.pid], [set[str]()]
    while len(graph) < 2 or not all(transports):
        assert killed.poll() is None and time.monotonic() < deadline
        time.sleep(0.02)
        graph = [killed.pid, *children(killed.pid)]
        transports = [dds_transports(pid) for pid in graph]
    left = [name for pid in graph for name in shared_memory(pid)]
    for pid in graph:
        os.kill(pid, signal.SIGKILL)
    assert killed.communicate(timeout=LIMIT)[0] == ""
    assert all(used == {"udp"} for used in transports) and not left


@pytest.mark.long
def test_a_paused_graph_goes_on(road: Path) -> None:
    """As `docker pause` does it; ROS forgets a node after 20 s."""
    road.write_text(json.dumps([(125.0, 25.0 * i) for i in range(9)]))
    paused = drive(road)
    while len(graph := [paused.pid, *children(paused.pid)]) < 2 or not all(map(dds_transports, graph)):
        assert paused.poll() is None
        time.sleep(0.02)
    time.sleep(2.0)
    for stop in (signal.SIGSTOP, signal.SIGCONT):
        for pid in graph:
            os.kill(pid, stop)
        if stop == signal.SIGSTOP:
            time.sleep(40.0)
    assert json.loads(paused.communicate(timeout=LIMIT)[0])["outcome"] == "COMPLETED"


def test_what_a_library_prints_does_not_reach_standard_output(road: Path, tmp_path: Path) -> None:
    """Fast DDS logs its errors there, here that a profile has the same name as another one; both are valid."""
    valid = PROFILE.read_text()
    begin, end = valid.index("<participant "), valid.index("</profiles>")
    profile = tmp_path / "profile.xml"
    profile.write_text(valid[:end] + valid[begin:])
    out, err = drive(road, FASTRTPS_DEFAULT_PROFILES_FILE=str(profile)).communicate(timeout=LIMIT)
    assert "Error adding profile" in err
    assert json.loads(out)["outcome"] == "COMPLETED"


def test_a_wider_discovery_range_brings_no_shared_memory_back() -> None:
    """The profile of one machine does not hold then."""
    chosen = os.environ | {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}
    chosen.pop("FASTRTPS_DEFAULT_PROFILES_FILE", None)
    done = subprocess.run([sys.executable, "-c", NODE], env=chosen, capture_output=True, text=True, timeout=LIMIT)
    assert (done.stdout.strip(), done.returncode) == ("", 0), done.stderr
