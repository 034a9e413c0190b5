# SPDX-License-Identifier: Apache-2.0
"""The rigid-body car as a URDF, and the world in which PyBullet places it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from ds_base.folder_files import write_whole
from ds_sim.simulator import FRAME_TIME
from ds_sim_bullet.parameters import GRAVITY, BulletParameters

HUB_RADIUS_OF_GYRATION = 0.12
"""Radius of gyration of hub and knuckle, m; chosen: hand-sized castings. They turn with body and steering only."""
STOP_DEPTH = 0.05
"""Travel from the rubber stop to metal, m; chosen: the stop then bears five times the static load."""
CORNERS = ("front_left", "front_right", "rear_left", "rear_right")
"""Order of the corners wherever there is one value per corner."""
_LINK = """\
  <link name="{name}">
    <inertial>
      <origin xyz="{centre}" />
      <mass value="{mass!r}" />
      <inertia ixx="{inertia[0]!r}" iyy="{inertia[1]!r}" izz="{inertia[2]!r}" ixy="0" ixz="0" iyz="0" />
    </inertial>{shape}
  </link>
"""
_SHAPE = """
    <collision>
      <origin xyz="{centre}" />
      <geometry>
        <{form} />
      </geometry>
    </collision>"""
_CONTACT = """
    <contact>
      <lateral_friction value="{!r}" />
    </contact>"""
_JOINT = """\
  <joint name="{name}" type="{kind}">
    <parent link="{parent}" />
    <child link="{child}" />
    <origin xyz="{place}" />
    <axis xyz="{axis}" />
    <dynamics damping="0" friction="0" />{limit}
  </joint>
"""
_LIMIT = """
    <limit lower="{!r}" upper="{!r}" effort="1e9" velocity="1e9" />"""
_ORIGIN = "0.0 0.0 0.0"


@lru_cache(maxsize=16)  # of a payload each; written again for each drive
def car_urdf(p: BulletParameters) -> str:
    """Generate the URDF of the car, with frames as in REP-103.

    At rest the root `base_link` is on the ground, midway between the axles. Joints of each corner: `<corner>_guide`
    (prismatic, positive up), `<corner>_steering` (revolute, positive left, front only), `<corner>_spin` (continuous,
    positive forward). The collision shape of a wheel is a sphere: it has a single contact point under the axle whatever
    the camber, and no edge that could catch.
    """
    box = _text(p.length, p.width, p.height - p.ground_clearance)
    shape = _SHAPE.format(centre=_text(0.0, 0.0, 0.5 * (p.height + p.ground_clearance)), form=f'box size="{box}"')
    centre = _text(p.body_forward, 0.0, p.centre_of_mass_height)
    body = _LINK.format(name="base_link", centre=centre, mass=p.sprung_mass, inertia=p.body_inertia, shape=shape)
    return f'<robot name="bullet_car">\n{body}{"".join(_corner(p, corner) for corner in CORNERS)}</robot>'


def _corner(p: BulletParameters, corner: str) -> str:
    """Links and joints of a hub, of the knuckle of a front wheel, and of the wheel."""
    front, left = corner.startswith("front"), corner.endswith("left")
    hub, wheel = f"{corner}_hub", f"{corner}_wheel"
    carrier = f"{corner}_knuckle" if front else hub
    mass = p.unsprung_mass - p.wheel_mass
    hub_mass = 0.5 * mass if front else mass
    inertia = (hub_mass * HUB_RADIUS_OF_GYRATION**2,) * 3
    place = _text((0.5 if front else -0.5) * p.wheelbase, (0.5 if left else -0.5) * p.track, p.wheel_radius)
    travel = p.travel + STOP_DEPTH

    def link(name: str, mass: float, inertia: tuple[float, float, float], shape: str = "") -> str:
        return _LINK.format(name=name, centre=_ORIGIN, mass=mass, inertia=inertia, shape=shape)

    def joint(name: str, kind: str, parent: str, child: str, axis: str, place: str = _ORIGIN, limit: str = "") -> str:
        name = f"{corner}_{name}"
        return _JOINT.format(name=name, kind=kind, parent=parent, child=child, place=place, axis=axis, limit=limit)

    parts = [
        link(hub, hub_mass, inertia),
        joint("guide", "prismatic", "base_link", hub, "0 0 1", place, _LIMIT.format(-travel, travel)),
    ]
    if front:
        parts.append(link(carrier, mass - hub_mass, inertia))
        parts.append(joint("steering", "revolute", hub, carrier, "0 0 1", limit=_LIMIT.format(-1.2, 1.2)))
    spin_inertia = p.wheel_spin_inertia + (0.0 if front else p.rotor_inertia)
    diametral_inertia = 0.5 * spin_inertia  # that of a thin ring
    sphere = _SHAPE.format(centre=_ORIGIN, form=f'sphere radius="{p.wheel_radius!r}"') + _CONTACT.format(p.friction)
    parts.append(link(wheel, p.wheel_mass, (diametral_inertia, spin_inertia, diametral_inertia), sphere))
    parts.append(joint("spin", "continuous", carrier, wheel, "0 1 0"))
    return "".join(parts)


def _text(*values: float) -> str:
    return " ".join(map(repr, values))


@dataclass(frozen=True, kw_only=True)
class CarIds:
    """PyBullet's ids of the car and its joints; one joint per corner in the order of `CORNERS`."""

    body: int  # id of the multibody
    guides: tuple[int, ...]  # joints of the four hubs, positive up (compression)
    steering: tuple[int, ...]  # joints of the two front knuckles, positive left
    spins: tuple[int, ...]  # joints of the four wheels, positive forward


def build_world(bullet: Any, client: int, p: BulletParameters, *, x: float, y: float, yaw: float) -> CarIds:
    """Reset the world, and put the car at rest on a plane, midway between its axles at (x, y), m, heading yaw (rad).

    Only a rebuilt world makes PyBullet reproducible bit for bit: its saved states lack the solver's internal state.
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
        write_whole(path, car_urdf(p))
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


def _find_joints(bullet: Any, client: int, body: int) -> CarIds:
    count = bullet.getNumJoints(body, physicsClientId=client)
    number = {bullet.getJointInfo(body, joint, physicsClientId=client)[1].decode(): joint for joint in range(count)}
    return CarIds(
        body=body,
        guides=tuple(number[f"{corner}_guide"] for corner in CORNERS),
        steering=tuple(number[f"{corner}_steering"] for corner in CORNERS[:2]),
        spins=tuple(number[f"{corner}_spin"] for corner in CORNERS),
    )


def _free_joints(bullet: Any, client: int, p: BulletParameters, car: CarIds) -> None:
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
