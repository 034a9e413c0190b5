# SPDX-License-Identifier: Apache-2.0
"""Signals while a node is still being imported."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

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
