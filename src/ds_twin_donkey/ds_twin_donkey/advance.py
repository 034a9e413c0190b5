# SPDX-License-Identifier: Apache-2.0
"""Advances the 1:16 car by a step; compiled by `ds_sim.machine_code`, which imports it only where it has to compile."""

from __future__ import annotations

from typing import Any

from numba import cfunc, from_dtype
from numba import types as numba_types
from numba.extending import register_jitable
from numba.np.numpy_support import carray

from ds_twin_donkey import dynamics
from ds_twin_donkey.dynamics import CAR, MOTION, move, pulse

types: Any = numba_types
_numbers = types.CPointer(types.float64)
for _function in (dynamics.move, dynamics.pulse, dynamics.wheel_angles, dynamics.slopes, dynamics.tyre):
    register_jitable(_function)


@cfunc(
    types.void(types.CPointer(from_dtype(CAR)), _numbers, types.int64, _numbers, _numbers, types.int64),
    error_model="numpy",
)
def compiled(car_record: Any, shares: Any, substeps: int, states: Any, commands: Any, frames: int) -> None:
    """Advance the car, a record `CAR`, by some frames, from the first of the states, (frames + 1, 17) `CarState`.

    The shares are (substeps, 5): that of the newer pulse, gain and largest move of the servo under the older pulse, and
    under the newer one. Of the commands, (frames + 1, 2), two after each other are in effect during a frame.
    """
    car = carray(car_record, 1)[0]
    all_states, all_commands = carray(states, (frames + 1, MOTION + 3)), carray(commands, (frames + 1, 2))
    p, parts = car.parameters, carray(shares, (substeps, 5))
    play = p.servo_backlash / 2.0
    for frame in range(frames):
        before_step, values = all_states[frame], all_states[frame + 1]
        for i in range(MOTION + 3):
            values[i] = before_step[i]
        motion = values[:MOTION]
        servo, wheels, duty = values[MOTION], values[MOTION + 1], values[MOTION + 2]
        older_angle, older_duty, older_brake = pulse(p, all_commands[frame, 0], all_commands[frame, 1])
        newer_angle, newer_duty, newer_brake = pulse(p, all_commands[frame + 1, 0], all_commands[frame + 1, 1])
        for i in range(substeps):
            share, older_gain, older_reach = parts[i, 0], parts[i, 1], parts[i, 2]
            newer_gain, newer_reach = parts[i, 3], parts[i, 4]
            rest = 1.0 - share
            # Apply one pulse after the other: at its rate limit, the servo would not respond to the share of a blend.
            servo += min(max((older_angle - servo) * older_gain, -older_reach), older_reach)
            servo += min(max((newer_angle - servo) * newer_gain, -newer_reach), newer_reach)
            before = wheels
            wheels = min(max(wheels, servo - play), servo + play)
            wanted = share * newer_duty + rest * older_duty
            middle = duty + 0.5 * (wanted - duty) * car.constants.motor_gain
            duty += (wanted - duty) * car.constants.motor_gain
            move(car, motion, 0.5 * (before + wheels), middle, share * newer_brake + rest * older_brake)
        values[MOTION], values[MOTION + 1], values[MOTION + 2] = servo, wheels, duty
