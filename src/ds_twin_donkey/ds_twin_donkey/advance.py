# SPDX-License-Identifier: Apache-2.0
"""Advances the 1:16 car by a step; compiled by `ds_sim.machine_code`, which imports it only where it has to compile."""

from __future__ import annotations

from typing import Any

from numba import cfunc, from_dtype
from numba import types as numba_types
from numba.extending import register_jitable
from numba.np.numpy_support import carray

from ds_twin_donkey import dynamics
from ds_twin_donkey.dynamics import CAR, MOTION, move

types: Any = numba_types
_numbers = types.CPointer(types.float64)
for _function in (dynamics.move, dynamics.wheel_angles, dynamics.slopes, dynamics.tyre):
    register_jitable(_function)


@cfunc(
    types.void(types.CPointer(from_dtype(CAR)), _numbers, types.int64, _numbers, _numbers),
    error_model="numpy",
)
def compiled(car_record: Any, shares: Any, substeps: int, state: Any, pulses: Any) -> None:
    """Advance the car by one step.

    Args:
        car_record: address of a record `CAR`.
        shares: (substeps, 5) share of the newer pulse, gain and largest move of the servo under the older pulse, and
            under the newer one.
        substeps: number of substeps.
        state: `CarState`, changed in place.
        pulses: older and newer `Pulse` in effect during the step.
    """
    car = carray(car_record, 1)[0]
    values = carray(state, MOTION + 3)
    p, motion = car.parameters, values[:MOTION]
    servo, wheels, duty = values[MOTION], values[MOTION + 1], values[MOTION + 2]
    pulse = carray(pulses, (2, 3))
    older_angle, older_duty, older_brake = pulse[0, 0], pulse[0, 1], pulse[0, 2]
    newer_angle, newer_duty, newer_brake = pulse[1, 0], pulse[1, 1], pulse[1, 2]
    play = p.servo_backlash / 2.0
    parts = carray(shares, (substeps, 5))
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
