# SPDX-License-Identifier: Apache-2.0
"""Rigid-body car as a `ds_sim.parts.Vehicle`: applies the driver's command to the joints, substep by substep."""

from __future__ import annotations

import ctypes
import importlib
import math
import os
import sys
import weakref
from collections.abc import Sequence
from typing import Any

import numpy as np

from ds_sim.parts import VEHICLE_CONDITIONS, Vehicle
from ds_sim.simulator import FRAME_TIME, Command, SimulatorError, VehicleState
from ds_sim_bullet.parameters import BulletParameters
from ds_sim_bullet.world import build_world


class Suspension:
    """Suspension forces at the four hubs, in the order of `ds_sim_bullet.world.CORNERS`."""

    def __init__(self, p: BulletParameters) -> None:
        self._travel, self._stop = p.travel, p.stop_stiffness
        front, rear = (
            (p.spring_load(front=f), p.spring_stiffness(front=f), p.spring_damping(front=f)) for f in (True, False)
        )
        self._corners = (front, front, rear, rear)
        self._bars = (p.front_anti_roll, p.rear_anti_roll)

    def forces(self, guides: Sequence[tuple[float, ...]]) -> list[float]:
        """Force on each hub, N, positive up; PyBullet's state of a guide begins with position, m, and velocity."""
        forces = []
        for (load, stiffness, damping), guide in zip(self._corners, guides, strict=True):
            position, velocity = guide[0], guide[1]
            beyond = position - min(max(position, -self._travel), self._travel)
            forces.append(-(load + stiffness * position + damping * velocity + self._stop * beyond))
        for axle, bar in enumerate(self._bars):
            twist = bar * (guides[2 * axle][0] - guides[2 * axle + 1][0])
            forces[2 * axle] -= twist
            forces[2 * axle + 1] += twist
        return forces


class BulletVehicle(Vehicle):
    """Small rear-wheel-drive electric car of rigid bodies in PyBullet, on an infinite plane.

    Body, hubs, knuckles and wheels form one multibody. Springs, dampers, anti-roll bars and motor are forces on its
    joints, a position motor turns the knuckles, and the tyres are contacts with Coulomb friction, which do not slip
    below its limit. Each vehicle owns a physics client.

    240 Hz is a compromise: after a slalom of 20 s and 98 m the car is 0.24 m from where it is at 3,840 Hz; 480 Hz
    halves that at twice the cost. Where a tyre slides, Bullet's cone friction is biased towards the direction in which
    the contact is harder to move: a sliding wheel spins faster or slower than a real one, and at the limit of grip the
    path depends on the heading in the world by 0.3% of the distance. The car has no brakes that could lock its wheels.

    Raises:
        ImportError: PyBullet is not installed.
        SimulatorError: PyBullet has no free physics client.
    """

    conditions = VEHICLE_CONDITIONS

    def __init__(self, parameters: BulletParameters | None = None) -> None:
        self._nominal = self.parameters = parameters or BulletParameters()
        self._bullet = _import_bullet()
        self._client = -1
        self._suspension = Suspension(self.parameters)
        self.reset(0.0, 0.0, 0.0, np.random.default_rng(0))

    def adjust(self, *, friction: float, payload: float) -> None:
        """Change grip and load for the runs to come; see `Vehicle.adjust`."""
        parameters = self._nominal.adjusted(friction=friction, payload=payload)
        if parameters != self.parameters:
            self.parameters = parameters
            self._suspension = Suspension(parameters)

    def reset(self, x: float, y: float, yaw: float, rng: np.random.Generator) -> None:
        """Build the world from scratch with the car at rest in equilibrium; `rng` is not used."""
        if self._client < 0:
            self._client = self._bullet.connect(self._bullet.DIRECT)
            if self._client < 0:
                raise SimulatorError("PyBullet has no free physics client: close vehicles that are not in use")
            self._release = weakref.finalize(self, self._bullet.disconnect, physicsClientId=self._client)
        self._car = build_world(self._bullet, self._client, self.parameters, x=x, y=y, yaw=yaw)
        self._yaw = yaw
        self._angle = 0.0
        self._steer()
        self._state = self._read()

    def advance(self, command: Command) -> None:
        """Advance by one step of 1/20 s with the command held."""
        p, car, bullet, client = self.parameters, self._car, self._bullet, self._client
        target = -command.steering * p.max_steering_angle
        rate = p.steering_rate * FRAME_TIME / p.substeps
        joints = [*car.guides, *car.spins[2:]]
        for _ in range(p.substeps):
            if target != self._angle:
                self._angle += min(max(target - self._angle, -rate), rate)
                self._steer()
            states = bullet.getJointStates(car.body, joints, physicsClientId=client)
            differential_speed = 0.5 * (states[4][1] + states[5][1])  # speed of the open differential's housing
            torque = p.drive_torque(command.throttle, differential_speed * p.wheel_radius)
            bullet.setJointMotorControlArray(
                car.body,
                joints,
                bullet.TORQUE_CONTROL,
                forces=[*self._suspension.forces(states[:4]), torque, torque],
                physicsClientId=client,
            )
            bullet.stepSimulation(physicsClientId=client)
        self._state = self._read()

    def state(self) -> VehicleState:
        """State of the midpoint between the axles, at the height of the body's centre of mass."""
        return self._state

    def close(self) -> None:
        """Disconnect the physics client."""
        if self._client >= 0:
            self._release()
            self._client = -1

    def _steer(self) -> None:
        """Set both knuckles to the current steering angle; they reach it within one substep."""
        p = self.parameters
        self._bullet.setJointMotorControlArray(
            self._car.body,
            self._car.steering,
            self._bullet.POSITION_CONTROL,
            targetPositions=p.wheel_angles(self._angle),
            positionGains=(1.0, 1.0),
            velocityGains=(1.0, 1.0),
            forces=(p.steering_torque, p.steering_torque),
            physicsClientId=self._client,
        )

    def _read(self) -> VehicleState:
        p, body, bullet, client = self.parameters, self._car.body, self._bullet, self._client
        (x, y, z), (qx, qy, qz, qw) = bullet.getBasePositionAndOrientation(body, physicsClientId=client)
        (vx, vy, _), (wx, wy, wz) = bullet.getBaseVelocity(body, physicsClientId=client)
        left, right = bullet.getJointStates(body, self._car.steering, physicsClientId=client)
        # Rotation matrix: the body's forward axis, and the z components of its left and up axes.
        fx, fy, fz = 1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy + qz * qw), 2 * (qx * qz - qy * qw)
        left_z, up_z = 2 * (qy * qz + qx * qw), 1 - 2 * (qx * qx + qy * qy)
        ahead = p.body_forward
        heading = math.atan2(fy, fx)
        self._yaw += math.remainder(heading - self._yaw, math.tau)  # counts full turns
        cos, sin = math.cos(heading), math.sin(heading)
        # Velocity of the midpoint: that of the centre of mass minus the part due to rotation.
        vx -= ahead * (wy * fz - wz * fy)
        vy -= ahead * (wz * fx - wx * fz)
        return VehicleState(
            x=x - ahead * fx,
            y=y - ahead * fy,
            yaw=self._yaw,
            speed=vx * cos + vy * sin,
            lateral_speed=vy * cos - vx * sin,
            yaw_rate=wz,
            steering_angle=p.mean_angle(left[0], right[0]),
            roll=math.atan2(left_z, up_z),
            pitch=math.asin(min(max(-fz, -1.0), 1.0)),
            heave=z - ahead * fz - p.centre_of_mass_height,
        )


def _import_bullet() -> Any:
    """Import PyBullet, an extra, without the banner that it prints to standard error from C."""
    sys.stderr.flush()
    stderr_copy, devnull = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(devnull, 2)
    os.close(devnull)
    try:
        bullet = importlib.import_module("pybullet")
        ctypes.CDLL(None).fflush(None)
        return bullet
    finally:
        os.dup2(stderr_copy, 2)
        os.close(stderr_copy)
