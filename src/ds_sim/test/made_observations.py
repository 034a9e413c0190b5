# SPDX-License-Identifier: Apache-2.0
"""Observations of a car that nobody simulated."""

from __future__ import annotations

from ds_sim.session import NO_IMAGE
from ds_sim.simulator import LaneState, Observation, Outcome, VehicleState


def made_observation(step: int = 0, **of_vehicle: float) -> Observation:
    """A frame of a drive 0.25 m to the right of the lane's centre, with these fields of the vehicle's state."""
    values = dict.fromkeys(("x", "y", "yaw", "yaw_rate", "steering_angle"), 0.0) | {"speed": 8.0} | of_vehicle
    lane = LaneState(lateral_position=0.25, lateral_distance=1.75, preview_lateral_position=0.25, arc_length=0.0)
    return Observation(
        image=NO_IMAGE,
        step=step,
        time=step / 20,
        vehicle=VehicleState(**values),
        lane=lane,
        outcome=Outcome.RUNNING,
    )
