# SPDX-License-Identifier: Apache-2.0
"""Child processes that get signals: a pool that is stopped, a node that still imports, a clock that stands still."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from ds_base.processes import RunningClock

PROGRAM = """
import signal, sys, time
from pathlib import Path
from ds_base.processes import map_in_processes

def work(seconds):
    Path(f"began_{seconds}").touch()
    time.sleep(seconds)

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    try:
        list(map_in_processes(work, [60, 61, 62, 63], workers=2, abandon=True))
    except KeyboardInterrupt:
        sys.exit("stopped")
"""


def running(group: int) -> list[str]:
    """States of the processes of a group that are no zombies, which wait for the system to forget them."""
    listed = subprocess.run(["ps", "-eo", "pgid=,stat=,args="], capture_output=True, text=True, check=True).stdout
    rows = [line.split(None, 2) for line in listed.splitlines()]
    return [row[-1] for row in rows if int(row[0]) == group and not row[1].startswith("Z")]


@pytest.mark.parametrize("working", [False, True], ids=["while the workers import", "while they work"])
def test_ctrl_c_leaves_neither_a_traceback_nor_a_process(tmp_path: Path, working: bool) -> None:
    (tmp_path / "program.py").write_text(PROGRAM)
    stopped = subprocess.Popen(
        [sys.executable, "program.py"], cwd=tmp_path, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    deadline = time.monotonic() + 60.0
    while (len(list(tmp_path.glob("began_*"))) < 2) if working else (len(running(stopped.pid)) < 3):
        assert time.monotonic() < deadline and stopped.poll() is None
        time.sleep(0.02)
    os.killpg(stopped.pid, signal.SIGINT)  # as a terminal does
    began = time.monotonic()
    _, printed = stopped.communicate(timeout=50.0)

    assert printed == "stopped\n" and stopped.returncode == 1
    assert time.monotonic() - began < 40.0  # the shortest job takes 60 s
    while running(stopped.pid):
        assert time.monotonic() < deadline
        time.sleep(0.05)


IMPORT = "import time; print('importing', flush=True); time.sleep(300.0)"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_during_the_imports_ends_the_process_silently_with_status_0(
    tmp_path: Path, number: signal.Signals
) -> None:
    """As `ros2 launch` wants it, which calls any other status a death."""
    (tmp_path / "slow_node.py").write_text(IMPORT)
    paths = os.pathsep.join((str(tmp_path), *sys.path))
    command = [sys.executable, "-c", "from ds_base.executables import start; start('slow_node')"]
    process = subprocess.Popen(
        command, env=os.environ | {"PYTHONPATH": paths}, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None and process.stdout.readline() == "importing\n"
    process.send_signal(number)
    _, errors = process.communicate(timeout=60.0)
    assert (process.returncode, errors) == (0, "")


LOOKS = """
import time
from ds_base import processes
processes.LONGEST_LOOK = 0.5
clock = processes.RunningClock()
began = clock.now()
print("began", flush=True)
for _ in range(20):
    time.sleep(0.05)
    clock.now()
print(clock.now() - began)
"""


@pytest.mark.parametrize("stopped", [0.0, 4.0])
def test_the_time_of_a_stopped_process_does_not_count(stopped: float) -> None:
    with subprocess.Popen([sys.executable, "-c", LOOKS], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        process.stdout.readline()
        process.send_signal(signal.SIGSTOP)
        time.sleep(stopped)
        process.send_signal(signal.SIGCONT)
        passed = float(process.stdout.readline())
    assert 1.0 <= passed < 3.5


def test_looks_in_time_see_all_of_it() -> None:
    clock = RunningClock()
    began, monotonic = clock.now(), time.monotonic()
    time.sleep(0.3)
    assert clock.now() - began == pytest.approx(time.monotonic() - monotonic, abs=0.1)
