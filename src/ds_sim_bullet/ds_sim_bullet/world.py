"""Builds the PyBullet world from scratch for every run: the car on a plane, in equilibrium."""

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
    """PyBullet's ids of the car and its joints; one joint per corner in the order of `CORNERS`.

    Attributes:
        body: id of the multibody.
        guides: joints of the four hubs, positive up (compression).
        steering: joints of the two front knuckles, positive left.
        spins: joints of the four wheels, positive forward.
    """

    body: int
    guides: tuple[int, ...]
    steering: tuple[int, ...]
    spins: tuple[int, ...]


def build_world(bullet: Any, client: int, p: BulletParameters, *, x: float, y: float, yaw: float) -> Car:
    """Reset the world and put the car on a plane, at rest.

    Only a rebuilt world makes PyBullet reproducible bit for bit: its saved states lack the solver's internal state.

    Args:
        bullet: the pybullet module.
        client: physics client that owns the world.
        p: parameters of the car.
        x: position of the midpoint between the axles, m.
        y: position of the midpoint between the axles, m.
        yaw: heading, rad.
    """
    bullet.resetSimulation(physicsClientId=client)
    bullet.setGravity(0.0, 0.0, -GRAVITY, physicsClientId=client)
    bullet.setPhysicsEngineParameter(
        fixedTimeStep=FRAME_TIME / p.substeps,
        numSubSteps=0,
        numSolverIterations=p.solver_iterations,
        solverResidualThreshold=0.0,  # run all iterations, whatever the residual
        erp=0.2,  # share of a penetration that Bullet corrects per substep
        contactERP=0.2,
        frictionERP=0.2,
        globalCFM=0.0,  # Coulomb friction has no creep below its limit
        enableConeFriction=1,  # a friction pyramid would grip better along the world's diagonals
        # m; Bullet's default of 0.02 keeps contact points that a rolling wheel has left behind: they carry no load and
        # take half of the time. PyBullet has one value per process, so it must be the same for every vehicle.
        contactBreakingThreshold=1e-4,
        deterministicOverlappingPairs=1,
        enableFileCaching=0,
        physicsClientId=client,
    )
    shape = bullet.createCollisionShape(bullet.GEOM_PLANE, planeNormal=(0.0, 0.0, 1.0), physicsClientId=client)
    floor = bullet.createMultiBody(0.0, shape, physicsClientId=client)
    # Bullet multiplies the friction coefficients of the two bodies in contact.
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
    """Remove PyBullet's defaults: damping of all motion, a brake on every joint, sleeping."""
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
    # The brake of a wheel joint models rolling resistance: dry friction, which also holds the car at rest.
    loads = [p.corner_load(front=corner.startswith("front")) for corner in CORNERS]
    brakes = [0.0] * len(car.guides) + [p.rolling_resistance * load * p.wheel_radius for load in loads]
    for joint, brake in zip((*car.guides, *car.spins), brakes, strict=True):
        bullet.setJointMotorControl2(
            car.body, joint, bullet.VELOCITY_CONTROL, targetVelocity=0.0, force=brake, physicsClientId=client
        )
