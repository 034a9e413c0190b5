# SPDX-License-Identifier: Apache-2.0
"""Converts standard command messages of another stack's driver to `DriveCommand`s for a simulator."""

from __future__ import annotations

import sys
import time
from operator import attrgetter
from typing import Any

from ds_interfaces.msg import DriveCommand, VehicleState
from ds_interfaces.srv import GetSimulatorInfo
from rclpy.node import Node
from std_msgs.msg import Header

from ds_driver.control.bicycle import Geometry, MotionError
from ds_driver.control.other_stacks import KINDS, MotionRequest, SpeedController, StampMatcher
from ds_driver.ros.simulator_client import SimulatorInfo, refusal
from ds_sim.ros.diagnostics import AnswerDiagnostics
from ds_sim.ros.parameters import declare
from ds_sim.ros.runtime import run_node
from ds_sim.ros.subscriptions import subscribe_to_commands


class CmdVelAdapter(Node):
    """Subscribes to the commands of another stack, and answers each frame of the simulator in its namespace.

    Stamp and speed of each frame come from the simulator's `state`, the vehicle's geometry from `get_info`.
    """

    def __init__(self) -> None:
        super().__init__("cmd_vel_adapter")
        name = declare(self, "message", "twist_stamped", "Message type of the driver's commands.", choices=tuple(KINDS))
        about = "copied: a command's stamp is that of the image it answers; ignored: it answers the newest image."
        self._ignore = declare(self, "stamps", "copied", about, choices=("copied", "ignored")) == "ignored"
        about = "Wheelbase of the vehicle, m; 0 asks the simulator."
        wheelbase = declare(self, "wheelbase", 0.0, about, low=0.0, high=100.0)
        about = "Wheel angle at full steering, rad; 0 asks the simulator."
        angle = declare(self, "max_steering_angle", 0.0, about, low=0.0, high=1.5)
        self._kind = KINDS[name]
        self._geometry = Geometry(wheelbase, angle) if wheelbase and angle else None
        self._speed_control = SpeedController()
        self._matching: StampMatcher[VehicleState, MotionRequest | MotionError] = StampMatcher()
        self._answers = AnswerDiagnostics(self)
        self._drive = self.create_publisher(DriveCommand, "drive", 1)
        self.create_subscription(VehicleState, "state", self._on_state, 5)
        subscribe_to_commands(self, self._kind.message_class, self._kind.topic, self._on_command, 5)
        if self._geometry is None:
            purpose = "for the vehicle's geometry (not needed with parameters wheelbase and max_steering_angle)"
            self._info = SimulatorInfo(self, [""], purpose, self._on_info)
            self._info.ask(0)
        self.get_logger().info(f"{self._kind.type_name} on {self._kind.topic} drives")

    def _on_info(self, _index: int, info: GetSimulatorInfo.Response) -> None:
        self._geometry = Geometry(info.wheelbase, info.max_steering_angle)
        self.get_logger().info(f"{info.name}: wheelbase {info.wheelbase:.3f} m, {info.max_steering_angle:.3f} rad")

    def _on_state(self, state: VehicleState) -> None:
        if state.step == 0:
            self._speed_control.reset()
        self._answer(self._matching.frame(_nanoseconds(state.header.stamp), state))

    def _on_command(self, message: Any) -> None:
        if self._geometry is None:
            return
        try:
            motion: MotionRequest | MotionError = self._kind.read(message, self._geometry)
        except MotionError as error:
            motion = error
        stamp = 0 if self._ignore or not self._kind.stamp else _nanoseconds(attrgetter(self._kind.stamp)(message))
        try:
            self._answer(self._matching.command(stamp, motion))
        except KeyError:
            text = "command ignored: no unanswered image has its stamp; copy the image's stamp, or set stamps:=ignored"
            self.get_logger().warning(text, throttle_duration_sec=5.0)

    def _answer(self, pair: tuple[VehicleState, MotionRequest | MotionError] | None) -> None:
        if pair is None:
            return
        state, motion = pair
        began = time.monotonic()
        header = Header(stamp=state.header.stamp, frame_id=state.header.frame_id)
        if isinstance(motion, MotionError):
            self._answers.refused += 1
            self.get_logger().warning(f"command refused: {motion}", throttle_duration_sec=1.0)
            self._drive.publish(refusal(header, motion))
            return
        if motion.throttle is not None:
            throttle = min(motion.throttle, 1.0)
        else:
            throttle = self._speed_control.throttle(motion.speed or 0.0, state.speed)
        self._drive.publish(DriveCommand(header=header, steering=motion.steering, throttle=throttle))
        self._answers.add(time.monotonic() - began)


def _nanoseconds(stamp: Any) -> int:
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def main() -> None:
    """Run the adapter until a signal stops it."""
    sys.exit(run_node(CmdVelAdapter))


if __name__ == "__main__":
    main()
