"""Soft-body car as a `ds_sim.parts.Vehicle`: frame, wheels, rack, motor, and the body's roll and pitch together."""

from __future__ import annotations

import math

import numpy as np

from ds_sim.simulator import FRAME_TIME, Command, SimulatorError, VehicleState
from ds_sim_softbody.lattice import VALUES_PER_NODE, Blueprint, CornerNodes, Lattice, blueprint
from ds_sim_softbody.parameters import GRAVITY, SoftbodyParameters
from ds_sim_softbody.wheel import Wheel, WheelPlan


class Steering:
    """Steering rack with a limited rate.

    Args:
        p: parameters of the car.
    """

    def __init__(self, p: SoftbodyParameters) -> None:
        self._p = p
        self.angle = 0.0
        """Mean angle of the front wheels set by the rack, rad, left positive."""

    def advance(self, command: Command, dt: float) -> tuple[float, float]:
        """Move towards the command for dt (s); returns the angles of the left and right wheel, rad, left positive."""
        p = self._p
        # The sign of the command is that of the paper, right positive.
        target = -command.steering * p.max_steering_angle
        step = p.steering_rate * dt
        self.angle += min(max(target - self.angle, -step), step)
        tangent = math.tan(self.angle)
        narrow = p.ackermann * tangent * p.track / (2.0 * p.wheelbase)
        return math.atan2(tangent, 1.0 - narrow), math.atan2(tangent, 1.0 + narrow)


class Motor:
    """Electric motor with a one-pedal map that drives the rear axle through an open differential.

    Args:
        p: parameters of the car.
    """

    def __init__(self, p: SoftbodyParameters) -> None:
        self._p = p
        self._gain = p.wheel_radius / 2.0
        self.torque = 0.0
        """Torque at each of the two rear wheels, N m."""

    def advance(self, command: Command, wheel_speed: float, dt: float) -> float:
        """Follow the pedal for dt; returns the torque at each rear wheel, N m.

        Args:
            command: command of the driver.
            wheel_speed: mean speed of the treads of the rear wheels, m/s.
            dt: duration, s.
        """
        p = self._p
        generating = min(max(wheel_speed / p.fade_speed, -1.0), 1.0)
        drive = p.drive_force if p.drive_force * wheel_speed < p.power else p.power / wheel_speed
        drive *= min(max(p.top_speed - wheel_speed, 0.0), 1.0)
        force = drive * command.throttle - p.regenerative_force * generating * (1.0 - command.throttle)
        self.torque += (force * self._gain - self.torque) * (1.0 - math.exp(-dt / p.motor_lag))
        return self.torque


class Attitude:
    """Roll and pitch as two damped oscillators, excited by the acceleration of the body (Gillespie, ch. 6).

    Load that springs and dampers do not carry reaches the wheels instantly, through the arms and the unsprung masses;
    in steady state the loads are those of the whole mass at the height of its centre.

    Args:
        p: parameters of the car.
    """

    def __init__(self, p: SoftbodyParameters) -> None:
        self._p = p
        self.roll = self.roll_rate = 0.0
        self.pitch = self.pitch_rate = 0.0
        axle = p.wheelbase / 2.0
        spring = p.sprung_mass * (math.tau * p.ride_frequency) ** 2
        self._roll_arm = p.centre_of_mass_height - p.roll_axis_height
        lever = p.sprung_mass * self._roll_arm
        # Net of gravity, which increases the lean: gradient = lever / stiffness.
        net_roll = lever / p.roll_gradient
        self._roll_stiffness = net_roll + lever * GRAVITY
        self._roll_damping = 2.0 * p.body_damping * math.sqrt(net_roll * p.roll_inertia)
        self._pitch_lever = p.sprung_mass * p.centre_of_mass_height
        self._pitch_stiffness = spring * axle**2
        net_pitch = self._pitch_stiffness - self._pitch_lever * GRAVITY
        self._pitch_damping = 2.0 * p.body_damping * math.sqrt(net_pitch * p.pitch_inertia)

    def advance(self, forward: float, left: float, dt: float) -> None:
        """Advance by dt (s) under an acceleration of the body (forward and left, m/s^2)."""
        p = self._p
        lever = p.sprung_mass * self._roll_arm
        roll_moment = lever * (left + GRAVITY * math.sin(self.roll)) - self._roll_reaction()
        pitch_moment = self._pitch_lever * (GRAVITY * math.sin(self.pitch) - forward) - self._pitch_reaction()
        self.roll_rate += roll_moment / p.roll_inertia * dt
        self.pitch_rate += pitch_moment / p.pitch_inertia * dt
        self.roll += self.roll_rate * dt
        self.pitch += self.pitch_rate * dt

    def loads(self, forward: float, left: float) -> tuple[float, float, float, float]:
        """Wheel loads under an acceleration of the body, N: front left, front right, rear left, rear right.

        A negative load means that the wheel is in the air.

        Args:
            forward: acceleration forward, m/s^2.
            left: acceleration to the left, m/s^2.
        """
        p = self._p
        total = p.mass * p.centre_of_mass_height
        direct = (total - p.sprung_mass * self._roll_arm) * left
        lean = self._roll_reaction()
        front = (lean * p.roll_front_share + direct * p.front_share) / p.track
        rear = (lean * (1.0 - p.roll_front_share) + direct * (1.0 - p.front_share)) / p.track
        dive = (self._pitch_reaction() - (total - self._pitch_lever) * forward) / p.wheelbase
        front_half = (p.mass * GRAVITY * p.front_share + dive) / 2.0
        rear_half = (p.mass * GRAVITY * (1.0 - p.front_share) - dive) / 2.0
        return front_half - front, front_half + front, rear_half - rear, rear_half + rear

    def _roll_reaction(self) -> float:
        """Restoring moment of springs and dampers in roll, N m."""
        return self._roll_stiffness * self.roll + self._roll_damping * self.roll_rate

    def _pitch_reaction(self) -> float:
        """Restoring moment of springs and dampers in pitch, N m."""
        return self._pitch_stiffness * self.pitch + self._pitch_damping * self.pitch_rate


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


class SoftbodyVehicle:
    """Car of nodes and beams on an infinite plane.

    The physics run in the car's axes at the start, so that a run does not depend on where it starts.

    Args:
        parameters: parameters of the car; nominal values if omitted.
    """

    def __init__(self, parameters: SoftbodyParameters | None = None) -> None:
        self._nominal = self._parameters = parameters or SoftbodyParameters()
        self._plan = blueprint(self._parameters)
        self._car: Car | None = None
        self._start = (0.0, 0.0, 0.0)

    @property
    def parameters(self) -> SoftbodyParameters:
        """Parameters of the car."""
        return self._parameters

    def adjust(self, *, friction: float, payload: float) -> None:
        """Change grip and load for the runs to come; see `ds_sim.parts.AdjustableVehicle`."""
        parameters = self._nominal.adjusted(friction=friction, payload=payload)
        if parameters != self._parameters:
            self._parameters, self._plan = parameters, blueprint(parameters)

    def reset(self, x: float, y: float, yaw: float, rng: np.random.Generator) -> None:
        """Build the car from scratch, at rest with its centre at (x, y), m, heading yaw (rad); `rng` is not used."""
        self._start = (x, y, yaw)
        self._car = Car(self._parameters, self._plan)

    def advance(self, command: Command) -> None:
        """Advance by one step of 1/20 s with the command held."""
        self._running().advance(command)

    def state(self) -> VehicleState:
        """State of the midpoint between the axles, of the undeformed frame fitted to the nodes."""
        car = self._running()
        motion = car.motion
        x, y, yaw = self._start
        cos, sin = math.cos(yaw), math.sin(yaw)
        own_cos, own_sin = math.cos(motion.yaw), math.sin(motion.yaw)
        return VehicleState(
            x=x + motion.x * cos - motion.y * sin,
            y=y + motion.x * sin + motion.y * cos,
            yaw=yaw + motion.yaw,
            speed=motion.velocity_x * own_cos + motion.velocity_y * own_sin,
            lateral_speed=motion.velocity_y * own_cos - motion.velocity_x * own_sin,
            yaw_rate=motion.yaw_rate,
            steering_angle=car.steering_angle(),
            roll=car.attitude.roll,
            pitch=car.attitude.pitch,
        )

    def close(self) -> None:
        """Release the frame; `reset` may follow."""
        self._car = None

    def _running(self) -> Car:
        if self._car is None:
            raise SimulatorError("the soft car has not been placed yet: call reset first")
        return self._car
