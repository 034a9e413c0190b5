# SPDX-License-Identifier: Apache-2.0
"""Integrates the published multi-body model, in machine code.

The package's own functions are compiled as they are: only the names by which they call each other are bound to compiled
functions. Everything that is compiled is in this file or in the pinned package, because Numba renews its cache, in
`__pycache__` beside this file or else in the user's cache folder, when this file changes and not for what it calls.
"""

from __future__ import annotations

import math
import types
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from vehiclemodels import vehicle_dynamics_mb as _multi_body
from vehiclemodels.utils import acceleration_constraints as _longitudinal
from vehiclemodels.utils import steering_constraints as _steering
from vehiclemodels.utils import tire_model as _tyres
from vehiclemodels.utils import vehicle_dynamics_ks_cog as _kinematic

from ds_sim_panda.vehicle import parameters as model

KINEMATIC_BELOW = 0.1
"""Speed below which the published model is kinematic, m/s."""


def _compiled(function: Callable[..., Any], **names: Any) -> Any:
    """Compile a function of the package with some of its global names bound to other things."""
    bound = types.FunctionType(function.__code__, {**function.__globals__, **names}, function.__name__)
    return njit(error_model="numpy")(bound)


def _cached(function: Callable[..., Any]) -> Any:
    """Compile a function of this file, and keep the result on disk where there is a folder to write to."""
    try:
        return njit(error_model="numpy", cache=True)(function)
    except RuntimeError:
        return njit(error_model="numpy")(function)


def _compiled_tyres() -> types.ModuleType:
    tyres = types.ModuleType("tyres")
    sign = _compiled(_tyres.sign)
    for name in ("longitudinal", "lateral", "longitudinal_comb", "lateral_comb"):
        setattr(tyres, f"formula_{name}", _compiled(getattr(_tyres, f"formula_{name}"), sign=sign))
    return tyres


_limits = {
    "steering_constraints": _compiled(_steering.steering_constraints),
    "acceleration_constraints": _compiled(_longitudinal.acceleration_constraints),
}
right_hand_side = _compiled(
    _multi_body.vehicle_dynamics_mb,
    vehicle_dynamics_ks_cog=_compiled(_kinematic.vehicle_dynamics_ks_cog, **_limits),
    tireModel=_compiled_tyres(),
    **_limits,
)
"""The package's `vehicle_dynamics_mb`, compiled: state (29,), inputs (2,), record of a parameter set -> list of 29."""


@njit(error_model="numpy")
def acceleration(throttle: float, speed: float, law: Any) -> float:
    """Acceleration that the drive asks for at a throttle and a speed, m/s^2, by a record of `MultiBodyParameters`."""
    fade = min(max(speed / law.fade_speed, 0.0), 1.0)
    neutral = law.neutral_throttle * fade
    if throttle >= neutral:
        limiter = min(max((law.max_speed + law.limiter_band - speed) / law.limiter_band, 0.0), 1.0)
        return law.drive_acceleration * (throttle - neutral) / (1.0 - neutral) * limiter
    return -law.regenerative_deceleration * fade * (neutral - throttle) / neutral


@njit(error_model="numpy")
def roll_freely(x: NDArray[np.float64], car: Any) -> None:
    """Make the yaw rate, the lateral velocities and the wheels agree with the kinematic model.

    Below `KINEMATIC_BELOW` the published model moves the car along a kinematic path, but leaves these states to forces
    without slip: the driven wheels of a car that starts would spin up to 4 m/s before the tyres take hold.
    """
    wheelbase = car.a + car.b
    speed, angle = x[model.SPEED], x[model.STEERING]
    at_centre = speed * math.tan(angle) * car.b / wheelbase
    yaw_rate = speed * math.cos(math.atan(math.tan(angle) * car.b / wheelbase)) * math.tan(angle) / wheelbase
    at_front = at_centre + car.a * yaw_rate
    x[model.YAW_RATE] = yaw_rate
    x[model.LATERAL_SPEED] = at_centre
    x[model.FRONT_LATERAL_SPEED] = at_front
    x[model.REAR_LATERAL_SPEED] = at_centre - car.b * yaw_rate
    for wheel in range(4):
        # The order of the model's wheels, whose left is where its lateral axis is negative.
        side = 0.5 if wheel % 2 == 0 else -0.5
        if wheel < 2:
            pace = (speed + side * car.T_f * yaw_rate) * math.cos(angle) + at_front * math.sin(angle)
        else:
            pace = speed + side * car.T_r * yaw_rate
        x[model.WHEEL_SPEEDS + wheel] = max(pace, 0.0) / car.R_w


@_cached
def derivative(x: NDArray[np.float64], inputs: NDArray[np.float64], car: Any, out: NDArray[np.float64]) -> None:
    """Write the right-hand side at a state to `out`, both (29,); as in the package, no wheel turns backwards.

    The inputs are the steering rate, rad/s, and the acceleration, m/s^2.
    """
    values = right_hand_side(x, inputs, car)
    for i in range(model.STATES):
        out[i] = values[i]


@_cached
def advance(
    x: NDArray[np.float64], steering: float, throttle: float, duration: float, substeps: int, car: Any, law: Any
) -> None:
    """Advance the state (29,) in place, by the classical Runge-Kutta method of order 4.

    The tyres' slip decays the faster the slower the car is: substeps are divided further where they have to be. The
    steering moves to an angle, rad, left positive; `car` and `law` are records of a parameter set and of
    `MultiBodyParameters`.
    """
    inputs = np.empty(2)
    first, second, third, fourth, trial = np.empty((5, model.STATES))
    for _ in range(substeps):
        speed = max(x[model.SPEED], KINEMATIC_BELOW)
        parts = int(math.ceil(duration / substeps * law.slip_rate / (law.stable_step * speed)))
        if x[model.SPEED] < 0.5 * KINEMATIC_BELOW:
            parts = 1
        h = duration / (substeps * parts)
        for _ in range(parts):
            inputs[0] = min(max((steering - x[model.STEERING]) / h, car.steering.v_min), car.steering.v_max)
            inputs[1] = acceleration(throttle, x[model.SPEED], law)
            derivative(x, inputs, car, first)
            for i in range(model.STATES):
                trial[i] = x[i] + 0.5 * h * first[i]
            derivative(trial, inputs, car, second)
            for i in range(model.STATES):
                trial[i] = x[i] + 0.5 * h * second[i]
            derivative(trial, inputs, car, third)
            for i in range(model.STATES):
                trial[i] = x[i] + h * third[i]
            derivative(trial, inputs, car, fourth)
            for i in range(model.STATES):
                x[i] += h / 6.0 * (first[i] + 2.0 * (second[i] + third[i]) + fourth[i])
            if x[model.SPEED] < KINEMATIC_BELOW:
                roll_freely(x, car)
