# SPDX-License-Identifier: Apache-2.0
"""Frame of the car: mass nodes joined by damped beams, seen from above, in a pymunk space without gravity.

The coordinates are those of the car at the start of a run: x forward, y left, origin midway between the axles.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pymunk
from numpy.typing import NDArray
from pymunk import batch
from pymunk._chipmunk_cffi import ffi, lib

from ds_sim_softbody.parameters import SoftbodyParameters

NODES = 20
"""Nodes of the frame."""
ENGINE_FUNCTIONS = {
    name: int(ffi.cast("intptr_t", ffi.addressof(lib, name)))
    for name in ("cpSpaceStep", "cpSpaceEachBody", "cpBodySetForce", "pmSpaceBodyGetIteratorFuncBatched")
}
"""Addresses of the functions of Chipmunk, the engine in pymunk, that compiled code calls."""


class CornerNodes(NamedTuple):
    """Indices of the nodes of one wheel and of the frame's bushes ahead of and behind its axis."""

    wheel: int
    fore: int
    aft: int


class Beam(NamedTuple):
    """Damped spring between two nodes: stiffness in N/m, damping in N s/m."""

    first: int
    second: int
    stiffness: float
    damping: float


@dataclass(frozen=True, kw_only=True)
class Blueprint:
    """Frame at rest."""

    positions: NDArray[np.float64]  # (n, 2) positions of the nodes, m; the four wheels first
    masses: NDArray[np.float64]  # (n,) masses of the nodes, kg
    beams: tuple[Beam, ...]  # beams between the nodes; their rest lengths follow from `positions`
    # Front left, front right, rear left, rear right.
    corners: tuple[CornerNodes, CornerNodes, CornerNodes, CornerNodes]


def blueprint(p: SoftbodyParameters) -> Blueprint:
    """Design the frame: four wheels and two cross-braced side rails of eight nodes, with the car's mass and inertia."""
    axle = p.wheelbase / 2.0
    stations = [
        p.bumper_distance,
        axle + p.bush_spacing,
        axle - p.bush_spacing,
        p.floor_distance,
        -p.floor_distance,
        -axle + p.bush_spacing,
        -axle - p.bush_spacing,
        -p.bumper_distance,
    ]
    wheels = [(x, y) for x in (axle, -axle) for y in (p.track / 2.0, -p.track / 2.0)]
    widths = [p.rail_half_width] * 3 + [p.sill_half_width] * 2 + [p.rail_half_width] * 3
    rails = [(x, y) for x, width in zip(stations, widths, strict=True) for y in (width, -width)]
    positions = np.array(wheels + rails)

    def rail(station: int, side: int) -> int:
        return len(wheels) + 2 * station + side

    front_left, front_right, rear_left, rear_right = (
        CornerNodes(2 * end + side, rail(first, side), rail(first + 1, side))
        for end, first in enumerate((1, 5))
        for side in (0, 1)
    )
    corners = (front_left, front_right, rear_left, rear_right)
    arms = [Beam(c.wheel, bush, p.arm_stiffness, p.arm_damping) for c in corners for bush in (c.fore, c.aft)]
    pairs = [(rail(s, 0), rail(s, 1)) for s in range(len(stations))]
    for s in range(len(stations) - 1):
        pairs += [(rail(s, a), rail(s + 1, b)) for a, b in ((0, 0), (1, 1), (0, 1), (1, 0))]
    frame = [Beam(i, j, p.frame_stiffness, p.frame_damping) for i, j in pairs]
    return Blueprint(positions=positions, masses=_masses(p, positions), beams=tuple(arms + frame), corners=corners)


def _masses(p: SoftbodyParameters, positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Node masses, kg: wheels and bumpers as given; subframes and floor such that mass, axle load and inertia match."""
    masses = np.zeros(len(positions))
    masses[:4] = p.unsprung_mass
    masses[[4, 5, 18, 19]] = p.bumper_mass
    groups = ([6, 7, 8, 9], [14, 15, 16, 17], [10, 11, 12, 13])
    ahead = p.centre_of_mass_ahead
    arms = np.sum((positions - (ahead, 0.0)) ** 2, axis=1)
    moments = np.vstack((np.ones(len(masses)), positions[:, 0] - ahead, arms))
    required = np.array([p.mass, 0.0, p.yaw_inertia]) - (moments * masses).sum(axis=1)
    # Cramer's rule. LAPACK, and BLAS for the products in this module, would round by the type of processor.
    means = [moments[:, group].mean(axis=1) for group in groups]
    normals = [np.cross(means[i - 2], means[i - 1]) for i in range(3)]
    shares = [float((required * n).sum() / (mean * n).sum()) for mean, n in zip(means, normals, strict=True)]
    for group, share in zip(groups, shares, strict=True):
        masses[group] = share / len(group)
    return masses


class RigidMotion(NamedTuple):
    """Motion of the frame as a whole: position and velocity of its centre (m, m/s), yaw (rad), yaw rate (rad/s)."""

    x: float
    y: float
    yaw: float
    velocity_x: float
    velocity_y: float
    yaw_rate: float


class Lattice:
    """Frame in motion, whose `read` fills nodes, (n, 4): positions, m, and velocities, m/s; as x, y, x, y."""

    def __init__(self, plan: Blueprint, nodes: NDArray[np.float64], *, iterations: int) -> None:
        self.nodes = nodes
        self.space = pymunk.Space()
        self.space.iterations = iterations
        self.bodies = []
        for (x, y), mass in zip(plan.positions.tolist(), plan.masses.tolist(), strict=True):
            body = pymunk.Body(mass, math.inf)
            body.position = x, y
            self.bodies.append(body)
        self.space.add(*self.bodies)
        for beam in plan.beams:
            a, b = self.bodies[beam.first], self.bodies[beam.second]
            dx, dy = b.position.x - a.position.x, b.position.y - a.position.y
            # Computed as the engine does, so that the forces in a frame at rest are exactly zero.
            length = math.sqrt(dx * dx + dy * dy)
            self.space.add(pymunk.DampedSpring(a, b, (0.0, 0.0), (0.0, 0.0), length, beam.stiffness, beam.damping))
        self._weights = plan.masses / plan.masses.sum()
        self._centre = (self._weights[:, None] * plan.positions).sum(axis=0)
        self._rest = plan.positions - self._centre
        # As in `pymunk.batch.get_space_bodies`, but filling an array of ours; the engine would move one that gets full.
        self._floats = ffi.new("pmFloatArray *", {"max": nodes.size + 2, "arr": ffi.from_buffer("double *", nodes)})
        fields = (batch.BodyFields.POSITION | batch.BodyFields.VELOCITY).value
        self._request = ffi.new("pmBatchedData *", {"floatArray": self._floats, "fields": fields})
        self.addresses = (
            _address(self.space._space),
            ENGINE_FUNCTIONS["pmSpaceBodyGetIteratorFuncBatched"],
            _address(self._request),
            [_address(body._body) for body in self.bodies[:4]],
        )
        """Addresses in the engine: space, function that reads a body, its request, and the bodies of the wheels."""
        self.values_read = _address(self._floats)
        """Address of the number of values in `nodes`, 32 bits: the engine appends to them."""
        self.read()

    def read(self) -> None:
        """Read positions and velocities of all nodes to `nodes`."""
        self._floats.num = 0
        reader = ffi.addressof(lib, "pmSpaceBodyGetIteratorFuncBatched")
        lib.cpSpaceEachBody(self.space._space, reader, self._request)

    def rigid_motion(self) -> RigidMotion:
        """Motion of the undeformed frame that fits `nodes` best, weighted by mass."""
        nodes = self.nodes
        middle = (self._weights[:, None] * nodes).sum(axis=0)
        x, y, velocity_x, velocity_y = (nodes - middle).T
        rest_x, rest_y = self._rest.T
        products = (rest_x * x + rest_y * y, rest_x * y - rest_y * x, x * velocity_y - y * velocity_x, x * x + y * y)
        along, across, spin, inertia = (self._weights * products).sum(axis=1).tolist()
        yaw, rate = math.atan2(across, along), spin / inertia
        # From the centre of mass back to the midpoint between the axles.
        cos, sin = math.cos(yaw), math.sin(yaw)
        back_x = -self._centre[0] * cos + self._centre[1] * sin
        back_y = -self._centre[0] * sin - self._centre[1] * cos
        return RigidMotion(
            x=float(middle[0] + back_x),
            y=float(middle[1] + back_y),
            yaw=yaw,
            velocity_x=float(middle[2] - rate * back_y),
            velocity_y=float(middle[3] + rate * back_x),
            yaw_rate=rate,
        )


def _address(pointer: Any) -> int:
    return int(ffi.cast("intptr_t", pointer))
