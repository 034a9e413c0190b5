"""Builds the world in PyBullet, anew for every run: the car, in equilibrium, on a plane."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from ds_sim.simulator import FRAME_TIME
from ds_sim_bullet.parameters import GRAVITY, BulletParameters
from ds_sim_bullet.urdf import CORNERS, car_urdf


@dataclass(frozen=True, kw_only=True)
class Car:
    """PyBullet's numbers of a car and its joints; fours in the order of `CORNERS`.

    Attributes:
        body: the multibody.
        guides: of the four hubs, positive up (compression).
        steering: of the two front knuckles, positive left.
        spins: of the four wheels, positive forward.
    """

    body: int
    guides: tuple[int, ...]
    steering: tuple[int, ...]
    spins: tuple[int, ...]


def build_world(bullet: Any, client: int, p: BulletParameters, *, x: float, y: float, yaw: float) -> Car:
    """Empty the world, lay a plane, and put the car on it, at rest.

    Rebuilding is the only way in which PyBullet repeats itself bit for bit: its saved states lack the solver's memory.

    Args:
        bullet: the pybullet module.
        client: the physics client that owns the world.
        p: the car.
        x: of the middle between the axles, m.
        y: of the middle between the axles, m.
        yaw: heading, rad.
    """
    bullet.resetSimulation(physicsClientId=client)
    bullet.setGravity(0.0, 0.0, -GRAVITY, physicsClientId=client)
    bullet.setPhysicsEngineParameter(
        fixedTimeStep=FRAME_TIME / p.substeps,
        numSubSteps=0,
        numSolverIterations=p.solver_iterations,
        solverResidualThreshold=0.0,  # every iteration, whatever the residual
        erp=0.2,  # Bullet's share of a penetration that is pushed out per substep
        contactERP=0.2,
        frictionERP=0.2,
        globalCFM=0.0,  # Coulomb's friction has no creep below its limit
        enableConeFriction=1,  # a pyramid grips better along the diagonals of the world
        # m; Bullet's 0.02 keeps points of contact that a rolling wheel left behind: they carry nothing and cost half
        # of the time. PyBullet holds this one value per process: it must be the same for every vehicle.
        contactBreakingThreshold=1e-4,
        deterministicOverlappingPairs=1,
        enableFileCaching=0,
        physicsClientId=client,
    )
    shape = bullet.createCollisionShape(bullet.GEOM_PLANE, planeNormal=(0.0, 0.0, 1.0), physicsClientId=client)
    floor = bullet.createMultiBody(0.0, shape, physicsClientId=client)
    # Bullet multiplies the frictions of the two that touch.
    bullet.changeDynamics(floor, -1, lateralFriction=1.0, restitution=0.0, physicsClientId=client)
    with TemporaryDirectory() as folder:  # PyBullet reads URDF from files only
        path = Path(folder) / "car.urdf"
        path.write_text(car_urdf(p), encoding="utf-8")
        body = bullet.loadURDF(
            str(path),
            basePosition=(x, y, 0.0),
            baseOrientation=(0.0, 0.0, math.sin(0.5 * yaw), math.cos(0.5 * yaw)),
            flags=bullet.URDF_USE_INERTIA_FROM_FILE,
            physicsClientId=client,
        )
    car = _find_joints(bullet, client, body)
    _free_joints(bullet, client, p, car)
    return car


def _find_joints(bullet: Any, client: int, body: int) -> Car:
    count = bullet.getNumJoints(body, physicsClientId=client)
    number = {bullet.getJointInfo(body, joint, physicsClientId=client)[1].decode(): joint for joint in range(count)}
    return Car(
        body=body,
        guides=tuple(number[f"{corner}_guide"] for corner in CORNERS),
        steering=tuple(number[f"{corner}_steering"] for corner in CORNERS[:2]),
        spins=tuple(number[f"{corner}_spin"] for corner in CORNERS),
    )


def _free_joints(bullet: Any, client: int, p: BulletParameters, car: Car) -> None:
    """Take away what PyBullet adds by itself: damping of all motion, a brake on every joint, sleep."""
    for link in range(-1, bullet.getNumJoints(car.body, physicsClientId=client)):
        bullet.changeDynamics(
            car.body,
            link,
            linearDamping=0.0,
            angularDamping=0.0,
            jointDamping=0.0,
            maxJointVelocity=1e4,
            restitution=0.0,
            activationState=bullet.ACTIVATION_STATE_DISABLE_SLEEPING,
            physicsClientId=client,
        )
    # The brake on a wheel becomes its rolling resistance: a dry friction, which also holds the car at rest.
    loads = [p.corner_load(front=corner.startswith("front")) for corner in CORNERS]
    brakes = [0.0] * len(car.guides) + [p.rolling_resistance * load * p.wheel_radius for load in loads]
    for joint, brake in zip((*car.guides, *car.spins), brakes, strict=True):
        bullet.setJointMotorControl2(
            car.body, joint, bullet.VELOCITY_CONTROL, targetVelocity=0.0, force=brake, physicsClientId=client
        )
