# SPDX-License-Identifier: Apache-2.0
"""The clock of waits stands still with its process, and with nothing else."""

from __future__ import annotations

import signal
import subprocess
import sys
import time

import pytest

from ds_base import running_clock

LOOKS = """
import time
from ds_base import running_clock
running_clock.LONGEST_LOOK = 0.5
clock = running_clock.RunningClock()
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
    clock = running_clock.RunningClock()
    began, monotonic = clock.now(), time.monotonic()
    time.sleep(0.3)
    assert clock.now() - began == pytest.approx(time.monotonic() - monotonic, abs=0.1)
