"""The body: mass nodes joined by damped beams, and four wheel nodes held by softer ones, in pymunk."""

from __future__ import annotations

import math

import pymunk

from ds_sim_softbody.parameters import SoftbodyParameters

_ITERATIONS = 1
"""Solver iterations: damped springs are forces, not constraints to be solved."""


class Lattice:
    """Nodes and beams at rest at a pose.

    Args:
        parameters: of the car.
        x: of the car's middle, m.
        y: of the car's middle, m.
        yaw: heading, rad.
    """

    def __init__(self, parameters: SoftbodyParameters, x: float, y: float, yaw: float) -> None:
        p = parameters
        self.space = pymunk.Space()
        self.space.gravity = (0.0, 0.0)
        self.space.iterations = _ITERATIONS
        self._cos, self._sin = math.cos(yaw), math.sin(yaw)
        self._origin = (x, y)
        half = p.body_half_width
        node_mass = p.body_mass / (3 * len(p.body_rows))
        self.rows = [[self._node(at, side, node_mass) for side in (half, 0.0, -half)] for at in p.body_rows]
        for index, row in enumerate(self.rows):
            self._beam(row[0], row[1], p.beam_stiffness, p.beam_damping)
            self._beam(row[1], row[2], p.beam_stiffness, p.beam_damping)
            self._beam(row[0], row[2], p.beam_stiffness, p.beam_damping)
            for following in self.rows[index + 1 : index + 2]:
                for i in range(3):
                    for k in range(max(0, i - 1), min(3, i + 2)):
                        self._beam(row[i], following[k], p.beam_stiffness, p.beam_damping)
                self._beam(row[0], following[2], p.beam_stiffness, p.beam_damping)
                self._beam(row[2], following[0], p.beam_stiffness, p.beam_damping)
        front, rear = p.wheelbase / 2, -p.wheelbase / 2
        self.wheels = [
            self._wheel(p, at, side, axle) for at, axle in ((front, 3), (rear, 1)) for side in (p.half_track, -p.half_track)
        ]
        self.body_nodes = [node for row in self.rows for node in row]
        self.nodes = [*self.body_nodes, *self.wheels]
        self.beams = len(self.space.constraints)

    def _node(self, ahead: float, left: float, mass: float) -> pymunk.Body:
        node = pymunk.Body(mass, math.inf)
        node.position = (
            self._origin[0] + ahead * self._cos - left * self._sin,
            self._origin[1] + ahead * self._sin + left * self._cos,
        )
        self.space.add(node)
        return node

    def _wheel(self, p: SoftbodyParameters, ahead: float, left: float, axle: int) -> pymunk.Body:
        """A wheel node on arms to the outer nodes of its own and the neighbouring rows, and to the axle's middle."""
        node = self._node(ahead, left, p.wheel_mass)
        side = 0 if left > 0 else 2
        for row in (axle - 1, axle, axle + 1):
            self._beam(node, self.rows[row][side], p.arm_stiffness, p.arm_damping)
        self._beam(node, self.rows[axle][1], p.arm_stiffness, p.arm_damping)
        return node

    def _beam(self, a: pymunk.Body, b: pymunk.Body, stiffness: float, damping: float) -> None:
        rest = (a.position - b.position).length
        self.space.add(pymunk.DampedSpring(a, b, (0, 0), (0, 0), rest, stiffness, damping))
