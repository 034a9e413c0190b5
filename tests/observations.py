# SPDX-License-Identifier: Apache-2.0
"""Frames of drives that no simulator has driven."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ds_road import LANE_WIDTH
from ds_sim.session import NO_IMAGE
from ds_sim.simulator import FRAME_TIME, LaneState, Observation, Outcome, VehicleState


def made_observation(
    step: int, lateral: float, outcome: Outcome, place: tuple[float, float], image: NDArray[np.uint8] = NO_IMAGE
) -> Observation:
    """A frame of a drive of 1 m along the lane in each, at 8 m/s."""
    x, y = place
    return Observation(
        image=image,
        step=step,
        time=step * FRAME_TIME,
        vehicle=VehicleState(x=x, y=y, yaw=0.0, speed=8.0, yaw_rate=0.0, steering_angle=0.0),
        lane=LaneState(
            lateral_position=lateral,
            lateral_distance=LANE_WIDTH / 2 - abs(lateral),
            preview_lateral_position=lateral,
            arc_length=float(step),
        ),
        outcome=outcome,
    )
