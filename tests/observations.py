# SPDX-License-Identifier: Apache-2.0
"""Observations of a car that nobody simulated, and drives of cars without a road."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ds_road import LANE_WIDTH
from ds_sim.parts import Vehicle
from ds_sim.session import NO_IMAGE
from ds_sim.simulator import FRAME_TIME, Command, LaneState, Observation, Outcome, VehicleState


def made_observation(
    step: int = 0,
    *,
    lateral: float = 0.25,
    outcome: Outcome = Outcome.RUNNING,
    image: NDArray[np.uint8] = NO_IMAGE,
    **of_vehicle: float,
) -> Observation:
    """A frame of a drive of 1 m along the lane in each, so far to the right of its centre."""
    values = dict.fromkeys(("x", "y", "yaw", "yaw_rate", "steering_angle"), 0.0) | {"speed": 8.0} | of_vehicle
    lane = LaneState(
        lateral_position=lateral,
        lateral_distance=LANE_WIDTH / 2 - abs(lateral),
        preview_lateral_position=lateral,
        arc_length=float(step),
    )
    vehicle = VehicleState(**values)
    return Observation(image=image, step=step, time=step * FRAME_TIME, vehicle=vehicle, lane=lane, outcome=outcome)


def drive(vehicle: Vehicle, frames: int, steering: float, throttle: float) -> list[VehicleState]:
    """Repeat a command; the state after each frame."""
    states = []
    for _ in range(frames):
        vehicle.advance(Command(steering, throttle))
        states.append(vehicle.state())
    return states
