# SPDX-License-Identifier: Apache-2.0
"""Observations of a car that nobody simulated, and drives of cars without a road."""

from __future__ import annotations

from ds_sim.parts import Vehicle
from ds_sim.session import NO_IMAGE
from ds_sim.simulator import Command, LaneState, Observation, Outcome, VehicleState


def made_observation(step: int = 0, **of_vehicle: float) -> Observation:
    """A frame of a drive 0.25 m to the right of the lane's centre, with these fields of the vehicle's state."""
    values = dict.fromkeys(("x", "y", "yaw", "yaw_rate", "steering_angle"), 0.0) | {"speed": 8.0} | of_vehicle
    lane = LaneState(lateral_position=0.25, lateral_distance=1.75, preview_lateral_position=0.25, arc_length=0.0)
    return Observation(
        image=NO_IMAGE, step=step, time=step / 20, vehicle=VehicleState(**values), lane=lane, outcome=Outcome.RUNNING
    )


def drive(vehicle: Vehicle, frames: int, steering: float, throttle: float) -> list[VehicleState]:
    """Repeat a command; the state after each frame."""
    states = []
    for _ in range(frames):
        vehicle.advance(Command(steering, throttle))
        states.append(vehicle.state())
    return states
