"""The soft-body car as a `ds_sim.vehicle.Vehicle`: beams carry the forces of four slipping tyres, substep by substep."""

from __future__ import annotations

import math

import numpy as np

from ds_sim.simulator import FRAME_TIME, Command, VehicleState
from ds_sim_softbody.lattice import Lattice
from ds_sim_softbody.parameters import SoftbodyParameters
from ds_sim_softbody.tyre import Tyre

_GRAVITY = 9.81
_AIR_DENSITY = 1.2
"""kg/m^3 at 20 degrees Celsius."""


class _Attitude:
    """One angle of the body on its springs: a damped oscillator driven by a moment."""

    def __init__(self, stiffness: float, frequency: float, damping_ratio: float) -> None:
        self._stiffness = stiffness
        self._square = (2 * math.pi * frequency) ** 2
        self._damping = 2 * damping_ratio * 2 * math.pi * frequency
        self.angle = 0.0
        self._rate = 0.0

    def step(self, moment: float, dt: float) -> float:
        """Advance; the moment that the suspension passes on to the wheels, N m."""
        self._rate += dt * (self._square * (moment / self._stiffness - self.angle) - self._damping * self._rate)
        self.angle += dt * self._rate
        return self._stiffness * (self.angle + self._damping / self._square * self._rate)


class SoftbodyVehicle:
    """A car of mass nodes and damped beams on four tyres with load transfer.

    Args:
        parameters: of the car; the nominal ones if left out.
    """

    def __init__(self, parameters: SoftbodyParameters | None = None) -> None:
        self.parameters = parameters or SoftbodyParameters()
        self._lattice: Lattice | None = None

    def reset(self, x: float, y: float, yaw: float, rng: np.random.Generator) -> None:
        """Build nodes, beams and tyres anew, at rest; see `Vehicle.reset`."""
        p = self.parameters
        self._lattice = Lattice(p, x, y, yaw)
        self._tyres = [Tyre(p, driven=index < 2) for index in range(4)]
        self._roll = _Attitude(p.roll_stiffness, p.roll_frequency, p.body_damping_ratio)
        self._pitch = _Attitude(p.pitch_stiffness, p.pitch_frequency, p.body_damping_ratio)
        self._steering_angle = 0.0
        self._acceleration = (0.0, 0.0)
        self._turns = round((yaw - math.atan2(math.sin(yaw), math.cos(yaw))) / (2 * math.pi))
        self._last_heading = math.atan2(math.sin(yaw), math.cos(yaw))

    def advance(self, command: Command) -> None:
        """Hold a command for one frame."""
        dt = FRAME_TIME / self.parameters.substeps
        for _ in range(self.parameters.substeps):
            self._substep(command, dt)

    def state(self) -> VehicleState:
        """Pose of the body's middle, from its nodes."""
        lattice = self._built()
        heading, cos, sin = self._heading()
        nodes = lattice.body_nodes
        x = math.fsum(node.position[0] for node in nodes) / len(nodes)
        y = math.fsum(node.position[1] for node in nodes) / len(nodes)
        vx = math.fsum(node.velocity[0] for node in nodes) / len(nodes)
        vy = math.fsum(node.velocity[1] for node in nodes) / len(nodes)
        spin = math.fsum(
            (n.position[0] - x) * (n.velocity[1] - vy) - (n.position[1] - y) * (n.velocity[0] - vx) for n in nodes
        ) / math.fsum((n.position[0] - x) ** 2 + (n.position[1] - y) ** 2 for n in nodes)
        return VehicleState(
            x=x,
            y=y,
            yaw=heading + 2 * math.pi * self._turns,
            speed=vx * cos + vy * sin,
            lateral_speed=-vx * sin + vy * cos,
            yaw_rate=spin,
            steering_angle=self._steering_angle,
            roll=self._roll.angle,
            pitch=self._pitch.angle,
        )

    def close(self) -> None:
        """Let the nodes go."""
        self._lattice = None

    def _built(self) -> Lattice:
        if self._lattice is None:
            raise RuntimeError("the vehicle was not reset: place it somewhere first")
        return self._lattice

    def _heading(self) -> tuple[float, float, float]:
        """Heading in (-pi, pi] with its cosine and sine, from the middles of front and rear; turns are counted."""
        rows = self._built().rows
        front, rear = rows[-1][1].position, rows[0][1].position
        dx, dy = front[0] - rear[0], front[1] - rear[1]
        heading = math.atan2(dy, dx)
        if heading - self._last_heading > math.pi:
            self._turns -= 1
        elif heading - self._last_heading < -math.pi:
            self._turns += 1
        self._last_heading = heading
        length = math.hypot(dx, dy)
        return heading, dx / length, dy / length

    def _substep(self, command: Command, dt: float) -> None:
        p, lattice = self.parameters, self._built()
        _, cos, sin = self._heading()
        ahead, left = self._acceleration
        self._steer(-command.steering * p.max_steering_angle, dt)
        loads = self._loads(
            self._roll.step(p.mass * p.gravity_height * left, dt), self._pitch.step(-p.mass * p.gravity_height * ahead, dt)
        )
        sum_ahead = sum_left = 0.0
        torque = self._engine_torque(command.throttle)
        for index, (node, tyre, load) in enumerate(zip(lattice.wheels, self._tyres, loads, strict=True)):
            axle_cos, axle_sin = self._axle(3 if index < 2 else 1)
            if index < 2:
                angle = self._wheel_angle(1.0 if index == 0 else -1.0)
                c, s = math.cos(angle), math.sin(angle)
                axle_cos, axle_sin = axle_cos * c - axle_sin * s, axle_sin * c + axle_cos * s
            vx, vy = node.velocity
            force, across = tyre.step(
                vx * axle_cos + vy * axle_sin, -vx * axle_sin + vy * axle_cos, load, torque if tyre.driven else 0.0, dt
            )
            fx, fy = force * axle_cos - across * axle_sin, force * axle_sin + across * axle_cos
            node.force = (fx, fy)
            sum_ahead += fx * cos + fy * sin
            sum_left += fy * cos - fx * sin
        middle = lattice.rows[2][1]
        vx, vy = middle.velocity
        speed = vx * cos + vy * sin
        drag = 0.5 * _AIR_DENSITY * p.drag_area * speed * abs(speed)
        middle.force = (-drag * cos, -drag * sin)
        self._acceleration = ((sum_ahead - drag) / p.mass, sum_left / p.mass)
        lattice.space.step(dt)

    def _steer(self, target: float, dt: float) -> None:
        step = self.parameters.steering_rate * dt
        self._steering_angle += min(max(target - self._steering_angle, -step), step)

    def _wheel_angle(self, side: float) -> float:
        """Angle of the left (+1) or right (-1) front wheel about its hub, by Ackermann's rule."""
        p = self.parameters
        tangent = math.tan(self._steering_angle)
        return math.atan2(p.wheelbase * tangent, p.wheelbase - side * p.half_track * tangent)

    def _axle(self, row: int) -> tuple[float, float]:
        """Direction in which an axle's wheels would run unsteered: across the lattice's row, flex included."""
        nodes = self._built().rows[row]
        (lx, ly), (rx, ry) = nodes[0].position, nodes[2].position
        dx, dy = lx - rx, ly - ry
        length = math.sqrt(dx * dx + dy * dy)
        return dy / length, -dx / length

    def _loads(self, roll_moment: float, pitch_moment: float) -> tuple[float, float, float, float]:
        """Loads front left, front right, rear left, rear right, N: at rest a quarter each; lifted wheels carry none.

        Turning left rolls the body to the right, which is positive and loads the right wheels.
        """
        p = self.parameters
        quarter = p.mass * _GRAVITY / 4
        track = 2 * p.half_track
        front, rear = p.front_roll_share * roll_moment / track, (1 - p.front_roll_share) * roll_moment / track
        dive = pitch_moment / p.wheelbase / 2
        return (
            max(quarter - front + dive, 0.0),
            max(quarter + front + dive, 0.0),
            max(quarter - rear - dive, 0.0),
            max(quarter + rear - dive, 0.0),
        )

    def _engine_torque(self, throttle: float) -> float:
        """Torque on each driven wheel, N m: the throttle drives, the closed part of it brakes, neither backwards."""
        p = self.parameters
        spin = 0.5 * (self._tyres[0].spin + self._tyres[1].spin)
        speed = max(spin * p.tyre_radius, 0.1)
        drive = throttle * min(p.max_drive_force, p.max_power / speed)
        brake = (1.0 - throttle) * p.engine_braking * math.tanh(spin * p.tyre_radius / 0.3)
        return 0.5 * (drive - brake) * p.tyre_radius
