"""Builds the car in PyBullet: body, four hubs on vertical guides, two steering knuckles, four wheels, on a plane."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from ds_sim.simulator import FRAME_TIME
from ds_sim_bullet.parameters import GRAVITY, BulletParameters

HUB_RADIUS_OF_GYRATION = 0.12
"""Of hub and knuckle, m; chosen: a casting the size of a hand. It only turns with the body or the steering."""
ROOF_DROP = 0.02
"""Slack between the body's shape and what its height says, m; only touches the ground when the car is upside down."""

_Vector = tuple[float, float, float]
_X, _Y, _Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
_HERE = (0.0, 0.0, 0.0)
_UPRIGHT = (0.0, 0.0, 0.0, 1.0)
_NO_SHAPE = -1
_BODY = 0  # what createMultiBody calls the base; link number i is i + 1 there


@dataclass(frozen=True, kw_only=True)
class Car:
    """A car in a physics client; fours are front left, front right, rear left, rear right.

    Attributes:
        body: PyBullet's number of the multibody.
        guides: four prismatic joints between body and hubs, positive up (compression).
        steering: two revolute joints of the front knuckles, positive left.
        spins: four revolute joints of the wheels, positive forward.
    """

    body: int
    guides: tuple[int, ...]
    steering: tuple[int, ...]
    spins: tuple[int, ...]


@dataclass(frozen=True, kw_only=True)
class _Link:
    parent: int
    mass: float
    inertia: _Vector
    joint: int
    axis: _Vector
    position: _Vector = _HERE
    shape: int = _NO_SHAPE


def build_world(bullet: Any, client: int, p: BulletParameters, *, x: float, y: float, yaw: float) -> Car:
    """Empty the world, lay a plane, and put the car on it in equilibrium, at rest.

    Rebuilding is the only way in which PyBullet repeats itself bit for bit: a restored state lacks the solver's memory.

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
        erp=0.2,  # Bullet's; the tyres' contacts have a stiffness of their own instead
        contactERP=0.2,
        frictionERP=0.2,
        globalCFM=0.0,
        enableConeFriction=1,  # a pyramid grips better along the diagonals of the world
        deterministicOverlappingPairs=1,
        physicsClientId=client,
    )
    floor_shape = bullet.createCollisionShape(bullet.GEOM_PLANE, planeNormal=_Z, physicsClientId=client)
    floor = bullet.createMultiBody(0.0, floor_shape, physicsClientId=client)
    bullet.changeDynamics(floor, -1, lateralFriction=1.0, restitution=0.0, physicsClientId=client)

    links, car = _links(bullet, client, p)
    ahead = p.body_forward
    bullet.createMultiBody(
        baseMass=p.sprung_mass,
        baseCollisionShapeIndex=_body_shape(bullet, client, p),
        basePosition=(x + ahead * math.cos(yaw), y + ahead * math.sin(yaw), p.centre_of_mass_height),
        baseOrientation=(0.0, 0.0, math.sin(0.5 * yaw), math.cos(0.5 * yaw)),
        linkMasses=[link.mass for link in links],
        linkCollisionShapeIndices=[link.shape for link in links],
        linkVisualShapeIndices=[_NO_SHAPE] * len(links),
        linkPositions=[link.position for link in links],
        linkOrientations=[_UPRIGHT] * len(links),
        linkInertialFramePositions=[_HERE] * len(links),
        linkInertialFrameOrientations=[_UPRIGHT] * len(links),
        linkParentIndices=[link.parent for link in links],
        linkJointTypes=[link.joint for link in links],
        linkJointAxis=[link.axis for link in links],
        physicsClientId=client,
    )
    _set_dynamics(bullet, client, p, car, links)
    return car


def _links(bullet: Any, client: int, p: BulletParameters) -> tuple[list[_Link], Car]:
    """The links in the order of their numbers, and which joint does what."""
    tyre = bullet.createCollisionShape(bullet.GEOM_SPHERE, radius=p.wheel_radius, physicsClientId=client)
    links: list[_Link] = []
    guides, steering, spins = [], [], []

    def add(link: _Link) -> int:
        links.append(link)
        return len(links) - 1

    hub = p.unsprung_mass - p.wheel_mass
    for front, side in ((True, 0.5), (True, -0.5), (False, 0.5), (False, -0.5)):
        corner = (
            (0.5 if front else -0.5) * p.wheelbase - p.body_forward,
            side * p.track,
            # The heavier axle presses its tyres flatter: its hubs sit lower under the level body.
            p.wheel_radius - p.corner_load(front=front) / p.tyre_stiffness - p.centre_of_mass_height,
        )
        share = 0.5 * hub if front else hub
        inertia = share * HUB_RADIUS_OF_GYRATION**2
        last = add(
            _Link(
                parent=_BODY,
                mass=share,
                inertia=(inertia, inertia, inertia),
                joint=bullet.JOINT_PRISMATIC,
                axis=_Z,
                position=corner,
            )
        )
        guides.append(last)
        if front:
            last = add(
                _Link(
                    parent=last + 1,
                    mass=hub - share,
                    inertia=(inertia, inertia, inertia),
                    joint=bullet.JOINT_REVOLUTE,
                    axis=_Z,
                )
            )
            steering.append(last)
        across = 0.5 * p.wheel_spin_inertia  # of a thin ring about its diameter
        around = p.wheel_spin_inertia + (0.0 if front else p.rotor_inertia)
        last = add(
            _Link(
                parent=last + 1,
                mass=p.wheel_mass,
                inertia=(across, around, across),
                joint=bullet.JOINT_REVOLUTE,
                axis=_Y,
                shape=tyre,
            )
        )
        spins.append(last)
    return links, Car(body=1, guides=tuple(guides), steering=tuple(steering), spins=tuple(spins))


def _body_shape(bullet: Any, client: int, p: BulletParameters) -> int:
    """A box that touches the ground only when the car lies on its side or roof."""
    middle = 0.5 * (p.height + p.ground_clearance)
    shape: int = bullet.createCollisionShape(
        bullet.GEOM_BOX,
        halfExtents=(0.5 * p.length, 0.5 * p.width, 0.5 * (p.height - p.ground_clearance)),
        collisionFramePosition=(-p.body_forward, 0.0, middle - p.centre_of_mass_height),
        physicsClientId=client,
    )
    return shape


def _set_dynamics(bullet: Any, client: int, p: BulletParameters, car: Car, links: list[_Link]) -> None:
    """Inertias, tyres and joints: nothing is left to Bullet's defaults, which damp what moves."""
    free = {"linearDamping": 0.0, "angularDamping": 0.0, "jointDamping": 0.0, "maxJointVelocity": 1e4}
    free |= {"restitution": 0.0, "rollingFriction": 0.0, "spinningFriction": 0.0, "physicsClientId": client}
    bullet.changeDynamics(
        car.body,
        -1,
        localInertiaDiagonal=p.body_inertia,
        lateralFriction=p.friction,
        activationState=bullet.ACTIVATION_STATE_DISABLE_SLEEPING,
        **free,
    )
    for index, link in enumerate(links):
        bullet.changeDynamics(
            car.body, index, localInertiaDiagonal=link.inertia, lateralFriction=p.friction, **free
        )
    for index in car.spins:
        bullet.changeDynamics(
            car.body,
            index,
            contactStiffness=p.tyre_stiffness,
            contactDamping=p.tyre_damping,
            physicsClientId=client,
        )
    # PyBullet brakes every joint until it is told otherwise; on the wheels this motor is the rolling resistance,
    # a dry friction that also holds the car at rest.
    resistances = dict.fromkeys(car.guides, 0.0)
    for position, index in enumerate(car.spins):
        load = p.corner_load(front=position < 2)
        resistances[index] = p.rolling_resistance * load * p.wheel_radius
    for index, torque in resistances.items():
        bullet.setJointMotorControl2(
            car.body, index, bullet.VELOCITY_CONTROL, targetVelocity=0.0, force=torque, physicsClientId=client
        )
