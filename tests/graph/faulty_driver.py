# SPDX-License-Identifier: Apache-2.0
"""Driver node that drives straight on and fails as a parameter or a file requests.

Parameters: `fault`, or `orders`, a file that is read at the start of each run; `at`, the frame at which it fails;
`delay`, s by which `late` answers late; `once`, a file that is created at the failure and prevents another one.
"""

from __future__ import annotations

import math
import os
import time
from pathlib import Path

import rclpy
from ds_interfaces.msg import DriveCommand, VehicleState
from rclpy.node import Node
from std_msgs.msg import Header

FAULTS = ("none", "crash", "hang", "twice", "late", "old", "nan", "beyond", "silent")
"""`twice` answers the frame before once more, then this frame twice; `beyond` leaves the valid range."""


class FaultyDriver(Node):
    """Answers the state of each frame, which has the stamp of its image, at half throttle."""

    def __init__(self) -> None:
        super().__init__("faulty_driver")
        self._fault = self.declare_parameter("fault", "none").value
        self._orders = Path(self.declare_parameter("orders", "/nowhere").value)
        self._at = self.declare_parameter("at", 20).value
        self._delay = self.declare_parameter("delay", 0.0).value
        self._once = Path(self.declare_parameter("once", "/nowhere").value)
        self._previous = Header()
        self._publisher = self.create_publisher(DriveCommand, "drive", 10)
        self.create_subscription(VehicleState, "state", self._drive, 10)

    def _say(self, header: Header, steering: float = 0.0, throttle: float = 0.5) -> None:
        self._publisher.publish(DriveCommand(header=header, steering=steering, throttle=throttle))

    def _due(self, step: int) -> str:
        if step == 0 and self._orders.exists():
            fault, at, delay = self._orders.read_text().split()
            self._fault, self._at, self._delay = fault, int(at), float(delay)
        assert self._fault in FAULTS
        if self._fault == "none" or step < self._at or self._once.exists():
            return "none"
        if self._once.parent.exists() and self._once != Path("/nowhere"):
            self._once.touch()
        return str(self._fault)

    def _drive(self, state: VehicleState) -> None:
        fault = self._due(state.step)
        if fault == "crash":
            os._exit(3)
        if fault == "hang":
            time.sleep(3600.0)
        if fault == "late" and state.step == self._at:
            time.sleep(self._delay)
        if fault == "twice":
            self._say(self._previous, steering=1.0, throttle=1.0)
        if fault == "old":
            self._say(Header(stamp=self.get_clock().now().to_msg()))
        elif fault == "nan":
            self._say(state.header, steering=math.nan)
        elif fault == "beyond":
            self._say(state.header, steering=-1.5)
        elif fault != "silent":
            self._say(state.header)
        if fault == "twice":
            self._say(state.header, steering=1.0)
        self._previous = state.header


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(FaultyDriver())
