# SPDX-License-Identifier: Apache-2.0
"""Driving without PyTorch leaves it unimported: it takes 2 s and 200 MB in every process."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytest.importorskip("rclpy")

DRIVES = """
import sys
import ds_driver
from ds_driver import Autopilot, DriverError, Frame, NetworkDriver, drive_road, load_pilot, make_driver
from ds_driver.closed_loop.simulation import DriveRequest
from ds_driver.networks.driver_name import DriverName
from ds_driver.closed_loop.worker_process import WorkerProcess
from ds_orchestrator.engines.start import check_driver
import ds_driver.ros.autopilot_node, ds_driver.ros.camera_driver_node, ds_driver.ros.driver_node
import ds_driver.ros.closed_loop_node
from ds_studies.whole_campaign import run_campaign
from ds_road import Road
from ds_sim import make_simulator

simulator = make_simulator("bullet")
road = Road([(20.0, 20.0), (20.0, 60.0), (30.0, 100.0), (40.0, 140.0)])
for name in ("autopilot", "dave2", "dave2@openvino"):
    check_driver(DriverName.parse(name), ["bullet"])
    driver = make_driver(name, simulator.spec)
    def stopping(observation):
        if observation.step == 3:
            raise DriverError("enough")
        return driver(observation)
    record = drive_road(simulator, stopping, road, seed=1)
    print(name, record.outcome.name, "torch" in sys.modules)
"""


def test_driving_with_onnx_runtime_or_openvino_imports_no_pytorch() -> None:
    other = subprocess.run([sys.executable, "-c", DRIVES], capture_output=True, text=True, timeout=120)
    assert other.stdout.splitlines() == [
        f"{name} DRIVER_SILENT False" for name in ("autopilot", "dave2", "dave2@openvino")
    ], other.stderr
