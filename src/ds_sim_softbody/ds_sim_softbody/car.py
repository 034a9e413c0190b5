"""Advances the soft car during one run: frame, wheels, body, rack and motor together."""

from __future__ import annotations

import math

from ds_sim.simulator import FRAME_TIME, Command
from ds_sim_softbody.actuators import Motor, Steering
from ds_sim_softbody.attitude import Attitude
from ds_sim_softbody.lattice import VALUES_PER_NODE, Blueprint, CornerNodes, Lattice
from ds_sim_softbody.parameters import GRAVITY, SoftbodyParameters
from ds_sim_softbody.wheel import Wheel, WheelPlan


class Car:
    """Soft car, initially at rest with its centre at the origin, heading along x.

    Frame and tyres take short substeps; body and actuators take one substep for every few of those.

    Args:
        p: parameters of the car.
        plan: frame at rest.
    """

    def __init__(self, p: SoftbodyParameters, plan: Blueprint) -> None:
        self._p = p
        self._lattice = Lattice(plan, iterations=p.solver_iterations)
        self._steering = Steering(p)
        self._motor = Motor(p)
        self._dt = FRAME_TIME / p.frame_substeps
        nodes = self._lattice.read()
        self._wheels = tuple(
            Wheel(p, _wheel_plan(p, corner, front=axle == 0), nodes, dt=self._dt)
            for axle in (0, 1)
            for corner in plan.corners[2 * axle : 2 * axle + 2]
        )
        self.attitude = Attitude(p)
        """Roll and pitch of the body."""
        self.motion = self._lattice.rigid_motion()
        """Motion of the frame as a whole; its yaw is not wrapped."""

    def advance(self, command: Command) -> None:
        """Advance by one step with the command held."""
        p, attitude, (front_left, front_right, rear_left, rear_right) = self._p, self.attitude, self._wheels
        steps = p.frame_substeps // p.body_substeps
        body_dt = steps * self._dt
        for _ in range(p.body_substeps):
            left, right = self._steering.advance(command, body_dt)
            front_left.turn(left)
            front_right.turn(right)
            tread = p.wheel_radius * (rear_left.spin + rear_right.spin) / 2.0
            rear_left.torque = rear_right.torque = self._motor.advance(command, tread, body_dt)
            forward, leftward = self._advance_frame(steps)
            attitude.advance(forward, leftward, body_dt)
            for wheel, load in zip(self._wheels, attitude.loads(forward, leftward), strict=True):
                wheel.carry(load)
        motion = self._lattice.rigid_motion()
        turned = math.remainder(motion.yaw - self.motion.yaw, math.tau)
        self.motion = motion._replace(yaw=self.motion.yaw + turned)

    def steering_angle(self) -> float:
        """Mean angle of the front wheels relative to the car's heading, including the flex of the frame, rad."""
        left, right, *_ = self._wheels
        angle = math.atan2(left.heading_y + right.heading_y, left.heading_x + right.heading_x)
        return math.remainder(angle - self.motion.yaw, math.tau)

    def loads(self) -> tuple[float, ...]:
        """Loads of the wheels, N: front left, front right, rear left, rear right."""
        return tuple(wheel.load for wheel in self._wheels)

    def _advance_frame(self, steps: int) -> tuple[float, float]:
        """Advance frame and wheels; returns the mean acceleration of the car, forward and left, m/s^2."""
        read, step, dt = self._lattice.read, self._lattice.step, self._dt
        tyres = tuple(zip((wheel.roll for wheel in self._wheels), self._lattice.push, strict=True))
        total_x = total_y = 0.0
        nodes: list[float] = []
        for _ in range(steps):
            nodes = read()
            for roll, push in tyres:
                force = roll(nodes)
                push(force, _CENTRE)
                total_x += force[0]
                total_y += force[1]
            step(dt)
        ahead_x, ahead_y = _ahead(nodes)
        scale = 1.0 / (steps * self._p.mass * math.hypot(ahead_x, ahead_y))
        return (
            (total_x * ahead_x + total_y * ahead_y) * scale,
            (total_y * ahead_x - total_x * ahead_y) * scale,
        )


_CENTRE = (0.0, 0.0)
"""Point at which a force acts; irrelevant, because nodes cannot rotate."""


def _ahead(nodes: list[float]) -> tuple[float, float]:
    """Vector from the rear wheels to the front wheels; the wheels are the first four nodes."""
    front, side, rear = 0, VALUES_PER_NODE, 2 * VALUES_PER_NODE
    return (
        nodes[front] + nodes[front + side] - nodes[rear] - nodes[rear + side],
        nodes[front + 1] + nodes[front + side + 1] - nodes[rear + 1] - nodes[rear + side + 1],
    )


def _wheel_plan(p: SoftbodyParameters, corner: CornerNodes, *, front: bool) -> WheelPlan:
    """Track rods ahead of the front wheels' axis and toe links behind the rear wheels' axis: both add understeer."""
    share = p.front_share if front else 1.0 - p.front_share
    return WheelPlan(
        corner=corner,
        static_load=p.mass * GRAVITY * share / 2.0,
        cornering_stiffness=p.front_cornering_stiffness if front else p.rear_cornering_stiffness,
        toe_per_shift=-1.0 / p.front_arm if front else 1.0 / p.rear_arm,
        spin_inertia=p.wheel_spin_inertia + (0.0 if front else p.rotor_inertia),
    )
