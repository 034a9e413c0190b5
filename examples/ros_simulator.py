# SPDX-License-Identifier: Apache-2.0
"""A ROS 2 simulator that knows only messages of this project: a bicycle with a speed lag, and a plain camera.

`python examples/ros_simulator.py` waits for steps; `--realtime` lets its time pass by itself. `ros_simulator.yaml`
beside it makes it a sibling: docs/any_ros_simulator.md.
"""

from __future__ import annotations

import argparse
import math
from contextlib import suppress

import numpy as np
import rclpy
from ds_interfaces.srv import LoadRoad
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image
from simulation_interfaces.srv import StepSimulation
from std_srvs.srv import Trigger

STEP = 0.01
FRAME = 5
WHEELBASE, SPEED_LAG = 2.6, 0.2
ROWS, COLUMNS, FOCAL, HEIGHT, PITCH = 60, 120, 55.0, 1.3, 0.14
FULL = QoSProfile(depth=100)


def spline(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """A centripetal Catmull-Rom spline, by Barry and Goldman's pyramid."""
    line = []
    for p0, p1, p2, p3 in zip(points, points[1:], points[2:], points[3:], strict=False):
        t0 = 0.0
        t1, t2, t3 = t0 + np.cumsum([math.dist(a, b) ** 0.5 for a, b in ((p0, p1), (p1, p2), (p2, p3))])
        t = np.linspace(t1, t2, 40, endpoint=False)[:, None]
        a1 = (t1 - t) / (t1 - t0) * p0 + (t - t0) / (t1 - t0) * p1
        a2 = (t2 - t) / (t2 - t1) * p1 + (t - t1) / (t2 - t1) * p2
        a3 = (t3 - t) / (t3 - t2) * p2 + (t - t2) / (t3 - t2) * p3
        b1 = (t2 - t) / (t2 - t0) * a1 + (t - t0) / (t2 - t0) * a2
        b2 = (t3 - t) / (t3 - t1) * a2 + (t - t1) / (t3 - t1) * a3
        line.append((t2 - t) / (t2 - t1) * b1 + (t - t1) / (t2 - t1) * b2)
    return np.vstack([*line, points[-2:-1]])


class Car:
    """Rear axle and front axle roll where they point; the pose is that of the middle between them."""

    def __init__(self, x: float, y: float, yaw: float) -> None:
        self.x, self.y, self.yaw, self.speed, self.turn = x, y, yaw, 0.0, 0.0
        self.side = 0.0

    def advance(self, speed: float, turn: float) -> None:
        """Follow a speed, m/s, and a yaw rate, rad/s, for one step."""
        self.speed += (speed - self.speed) * STEP / SPEED_LAG
        self.turn = turn * self.speed / speed if speed > 1e-3 else 0.0
        self.side = self.turn * WHEELBASE / 2
        self.x += (self.speed * math.cos(self.yaw) - self.side * math.sin(self.yaw)) * STEP
        self.y += (self.speed * math.sin(self.yaw) + self.side * math.cos(self.yaw)) * STEP
        self.yaw += self.turn * STEP


class Camera:
    """Looks up the colour of the ground at each pixel by its distance from the centre line."""

    def __init__(self, line: NDArray[np.float64], lane_width: float) -> None:
        ahead = np.gradient(line, axis=0)
        self.line, self.ahead = line, ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
        self.lane_width = lane_width
        rows, columns = np.mgrid[:ROWS, :COLUMNS]
        down, right = (rows - ROWS / 2 + 0.5) / FOCAL, (columns - COLUMNS / 2 + 0.5) / FOCAL
        sinks = math.sin(PITCH) + down * math.cos(PITCH)
        self.ground = sinks > 0.02
        far = HEIGHT / sinks[self.ground]
        self.forward = far * (math.cos(PITCH) - down * math.sin(PITCH))[self.ground]
        self.left = -far * right[self.ground]

    def image(self, car: Car) -> NDArray[np.uint8]:
        """RGB image of the road from the middle of the car."""
        image = np.full((ROWS, COLUMNS, 3), (150, 190, 230), np.uint8)
        cos, sin = math.cos(car.yaw), math.sin(car.yaw)
        x = car.x + cos * self.forward - sin * self.left
        y = car.y + sin * self.forward + cos * self.left
        near = np.hypot(self.line[:, 0] - car.x, self.line[:, 1] - car.y) < 60.0
        line, ahead = self.line[near][::2], self.ahead[near][::2]
        nearest = np.argmin((x[:, None] - line[:, 0]) ** 2 + (y[:, None] - line[:, 1]) ** 2, axis=1)
        dx, dy = x - line[nearest, 0], y - line[nearest, 1]
        lateral = ahead[nearest, 1] * dx - ahead[nearest, 0] * dy  # right positive
        off = np.abs(ahead[nearest, 0] * dx + ahead[nearest, 1] * dy)
        colours = np.full((len(x), 3), (70, 120, 50), np.uint8)
        on_road = (np.abs(lateral) < self.lane_width) & (off < 3.0)
        colours[on_road] = (90, 90, 92)
        colours[on_road & (np.abs(lateral) > self.lane_width - 0.2)] = (235, 235, 235)
        colours[on_road & (np.abs(lateral) < 0.1)] = (225, 190, 40)
        image[self.ground] = colours
        return image


class Simulator(Node):
    """Stepped by the standard's service, or by a timer."""

    def __init__(self, *, realtime: bool) -> None:
        super().__init__("ros_simulator")
        self.ticks, self.asked = 0, (0.0, 0.0)
        self.load([(float(x), 25.0 * i) for i, x in enumerate((125, 125, 125, 125, 125))], 4.0, left=False)
        self.images = self.create_publisher(Image, "car/camera", FULL)
        self.odometry = self.create_publisher(Odometry, "car/odom", FULL)
        self.create_subscription(Twist, "car/cmd", self.on_command, FULL)
        self.create_service(LoadRoad, "load_road", self.on_load)
        self.create_service(Trigger, "reset", self.on_reset)
        if realtime:
            self.create_timer(STEP, self.tick)
        else:
            self.create_service(StepSimulation, "step_simulation", self.on_step)

    def load(self, points: list[tuple[float, float]], lane_width: float, *, left: bool) -> None:
        """Build the road through these points, and put the car to the start of a lane."""
        line = spline(np.array(points))
        ahead = line[1] - line[0]
        ahead /= np.linalg.norm(ahead)
        side = (1.0 if left else -1.0) * lane_width / 2
        self.start = (line[0, 0] - side * ahead[1], line[0, 1] + side * ahead[0], math.atan2(ahead[1], ahead[0]))
        self.camera = Camera(line, lane_width)
        self.restart()

    def restart(self) -> None:
        """Put the car to the start, at rest, at time 0."""
        self.car, self.ticks, self.asked = Car(*self.start), 0, (0.0, 0.0)

    def on_command(self, message: Twist) -> None:
        """Hold a command."""
        self.asked = message.linear.x, message.angular.z

    def on_load(self, request: LoadRoad.Request, response: LoadRoad.Response) -> LoadRoad.Response:
        """Load the road of a request."""
        road = request.road
        self.load([(p.x, p.y) for p in road.control_points], road.lane_width or 4.0, left=road.left_lane)
        response.accepted = True
        return response

    def on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Begin anew on the same road."""
        self.restart()
        response.success = True
        return response

    def on_step(self, request: StepSimulation.Request, response: StepSimulation.Response) -> StepSimulation.Response:
        """Pass some steps; the answer follows their messages."""
        for _ in range(request.steps):
            self.tick()
        response.result.result = response.result.RESULT_OK
        return response

    def tick(self) -> None:
        """Pass one step; every fifth has an image."""
        self.car.advance(*self.asked)
        self.ticks += 1
        stamp = rclpy.time.Time(nanoseconds=round(self.ticks * STEP * 1e9)).to_msg()
        self.odometry.publish(self.pose(stamp))
        if self.ticks % FRAME == 0:
            self.images.publish(self.picture(stamp))

    def pose(self, stamp: object) -> Odometry:
        """Pose and speeds now."""
        message = Odometry()
        message.header.stamp = stamp
        message.pose.pose.position.x, message.pose.pose.position.y = self.car.x, self.car.y
        message.pose.pose.orientation.z = math.sin(self.car.yaw / 2)
        message.pose.pose.orientation.w = math.cos(self.car.yaw / 2)
        message.twist.twist.linear.x, message.twist.twist.linear.y = self.car.speed, self.car.side
        message.twist.twist.angular.z = self.car.turn
        return message

    def picture(self, stamp: object) -> Image:
        """What the camera sees now."""
        pixels = self.camera.image(self.car)
        message = Image(height=ROWS, width=COLUMNS, encoding="rgb8", step=3 * COLUMNS)
        message.header.stamp = stamp
        message.data = pixels.tobytes()
        return message


def run(kind: type[Simulator] = Simulator) -> None:
    """Host a simulator until a signal comes."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--realtime", action="store_true")
    arguments = parser.parse_args()
    rclpy.init()
    node = kind(realtime=arguments.realtime)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    print("ready", flush=True)
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        executor.spin()


if __name__ == "__main__":
    run()
