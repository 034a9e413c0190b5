# SPDX-License-Identifier: Apache-2.0
"""Advances the soft car by a step; compiled by `ds_sim.machine_code`, which imports it only where it has to compile."""

from __future__ import annotations

from typing import Any

from numba import cfunc, from_dtype
from numba import types as numba_types
from numba.extending import register_jitable
from numba.np.numpy_support import carray

from ds_sim.simulator import FRAME_TIME
from ds_sim_softbody import parts
from ds_sim_softbody.parts import CAR, carry, drive, hypot, lean, loads, roll, steer, turn

types: Any = numba_types
_step = types.ExternalFunction("cpSpaceStep", types.void(types.intp, types.float64))
_each_body = types.ExternalFunction("cpSpaceEachBody", types.void(types.intp, types.intp, types.intp))
# A vector of C by value is two numbers in registers.
_set_force = types.ExternalFunction("cpBodySetForce", types.void(types.intp, types.float64, types.float64))


def _advance_frame(car: Any, values_read: Any, steps: int, dt: float) -> tuple[float, float]:
    """Advance frame and wheels; returns the mean acceleration of the car, forward and left, m/s^2."""
    p, wheels, nodes, bodies = car.parameters, car.wheels, car.nodes, car.bodies
    total_x = total_y = 0.0
    for _ in range(steps):
        values_read[0] = 0
        _each_body(car.space, car.each_body, car.request)
        for i in range(4):
            force_x, force_y = roll(wheels[i], p, nodes, dt)
            _set_force(bodies[i], force_x, force_y)
            total_x += force_x
            total_y += force_y
        _step(car.space, dt)
    # From the rear wheels to the front wheels, which are the first nodes.
    ahead_x = nodes[0, 0] + nodes[1, 0] - nodes[2, 0] - nodes[3, 0]
    ahead_y = nodes[0, 1] + nodes[1, 1] - nodes[2, 1] - nodes[3, 1]
    scale = 1.0 / (steps * p.mass * hypot(ahead_x, ahead_y))
    return (total_x * ahead_x + total_y * ahead_y) * scale, (total_y * ahead_x - total_x * ahead_y) * scale


for _function in (
    *(parts.hypot, parts._rounding, parts.turn, parts.carry, parts.shift, parts.roll, parts.steer, parts.drive),
    *(parts.lean, parts.loads, parts.roll_reaction, parts.pitch_reaction, _advance_frame),
):
    register_jitable(_function)


@cfunc(
    types.void(types.CPointer(from_dtype(CAR)), types.CPointer(types.int32), types.float64, types.float64),
    error_model="numpy",
)
def compiled(car_record: Any, values_read: Any, steering: float, throttle: float) -> None:
    """Advance the car, a record `CAR`, by one step of 1/20 s with the command held; `values_read` as `Lattice` has it.

    Frame and tyres take short substeps; body and actuators take one substep for every few of those.
    """
    car = carray(car_record, 1)[0]
    count = carray(values_read, 1)
    p, wheels, attitude = car.parameters, car.wheels, car.attitude
    dt = FRAME_TIME / p.frame_substeps
    steps = p.frame_substeps // p.body_substeps
    body_dt = steps * dt
    for _ in range(p.body_substeps):
        left, right = steer(car.actuators, p, steering, body_dt)
        turn(wheels[0], left)
        turn(wheels[1], right)
        tread = p.wheel_radius * (wheels[2].spin + wheels[3].spin) / 2.0
        wheels[2].torque = wheels[3].torque = drive(car.actuators, p, throttle, tread, body_dt)
        forward, leftward = _advance_frame(car, count, steps, dt)
        lean(attitude, p, forward, leftward, body_dt)
        front_left, front_right, rear_left, rear_right = loads(attitude, p, forward, leftward)
        carry(wheels[0], p, front_left)
        carry(wheels[1], p, front_right)
        carry(wheels[2], p, rear_left)
        carry(wheels[3], p, rear_right)
