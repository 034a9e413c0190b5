# SPDX-License-Identifier: Apache-2.0
"""The simulator of `examples/ros_simulator.py`, which misbehaves after a second in the way that FAULT names.

Its service `reload` reads a road from the file that ROAD names.
"""

from __future__ import annotations

import json
import math
import os
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from rclpy.subscription import Subscription
from ros_simulator import Simulator, run
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger

FAULT, ROAD = os.environ.get("FAULT"), Path(os.environ.get("ROAD", ""))


class FaultySimulator(Simulator):
    """Breaks one message in the way of its fault."""

    def __init__(self, *, realtime: bool) -> None:
        super().__init__(realtime=realtime)
        self.create_service(Trigger, "reload", self.on_reload)
        self.waiting: Twist | None = None
        if FAULT == "preempted":
            self.preempt()

    def preempt(self) -> None:
        """Take a command after the next request: so does an executor that is preempted just after it looked for any."""
        group = self.default_callback_group
        ended = group.ending_execution

        def ending_execution(entity: Any) -> None:
            ended(entity)
            if self.waiting is not None and not isinstance(entity, Subscription):
                super(FaultySimulator, self).on_command(self.waiting)
                self.waiting = None

        group.ending_execution = ending_execution

    def on_command(self, message: Twist) -> None:
        if FAULT == "preempted":
            self.waiting = message
        else:
            super().on_command(message)

    def on_reload(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        road = json.loads(ROAD.read_text())
        (x0, y0), (x1, y1), *_ = points = road["centre_line"]
        self.load([(2 * x0 - x1, 2 * y0 - y1), *points], road["lane_width"], left=road["lane"] == "left")
        response.success = True
        return response

    def pose(self, stamp: object) -> Odometry:
        message = super().pose(stamp)
        if FAULT == "nan" and self.ticks > 100:
            message.pose.pose.position.x = math.nan
        if FAULT == "stamps":
            message.header.stamp.sec, message.header.stamp.nanosec = 0, 0
        return message

    def picture(self, stamp: object) -> Image:
        message = super().picture(stamp)
        if FAULT == "encoding" and self.ticks > 100:
            message.encoding = "32FC1"
        return message


if __name__ == "__main__":
    run(FaultySimulator)
