"""The closed loop of vehicle, lane and autopilot without camera and ROS: what a frame's physics decide, and no more."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ds_driver.control.autopilot import Autopilot
from ds_road import Road
from ds_sim.lane_tracker import LaneTracker
from ds_sim.oracle import Oracle
from ds_sim.simulator import FRAME_TIME, AutopilotGains, Outcome
from ds_sim.vehicle import Vehicle
from ds_sim_bullet import simulator as bullet
from ds_sim_bullet.parameters import BulletParameters
from ds_sim_bullet.vehicle import BulletVehicle
from ds_sim_softbody import simulator as softbody
from ds_sim_softbody.parameters import SoftbodyParameters
from ds_sim_softbody.vehicle import SoftbodyVehicle
from ds_twin_donkey import dynamics
from ds_twin_donkey import simulator as donkey
from ds_twin_donkey.dynamics import CarModel
from ds_twin_donkey.parameters import DonkeyParameters
from ds_twin_donkey.vehicle import DonkeyVehicle


@dataclass(frozen=True, kw_only=True)
class Drive:
    """One run.

    Attributes:
        fitness: smallest lateral distance, m (paper 3.3).
        outcome: how it ended.
        path: (frames + 1, 4) of x, y, yaw, speed in road metres, the start included.
    """

    fitness: float
    outcome: Outcome
    path: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Car:
    """A vehicle that can be made with finer steps, and how its autopilot drives it.

    Attributes:
        make: a vehicle whose substeps are so many times the nominal ones.
        gains: of its autopilot.
        preview: m ahead of the car's middle that the autopilot watches.
        substep: nominal, s.
    """

    make: Callable[[int], Vehicle]
    gains: AutopilotGains
    preview: float
    substep: float


def cars() -> dict[str, Car]:
    """The three vehicles by the names of their simulators."""
    return {
        "bullet": Car(
            make=_bullet,
            gains=bullet.GAINS,
            preview=bullet.PREVIEW_DISTANCE,
            substep=FRAME_TIME / BulletParameters().substeps,
        ),
        "softbody": Car(
            make=_softbody,
            gains=softbody.GAINS,
            preview=softbody.PREVIEW_DISTANCE,
            substep=FRAME_TIME / SoftbodyParameters().frame_substeps,
        ),
        "donkey": Car(
            make=_donkey,
            gains=donkey.GAINS,
            preview=donkey.PREVIEW_DISTANCE,
            substep=FRAME_TIME / dynamics.SUBSTEPS,
        ),
    }


def drive(car: Car, vehicle: Vehicle, road: Road) -> Drive:
    """Let the autopilot drive a road, as `ds_sim.road_simulator` would, until the run ends."""
    lane = road.right_lane_centre
    ahead = lane[1] - lane[0]
    vehicle.reset(float(lane[0, 0]), float(lane[0, 1]), math.atan2(ahead[1], ahead[0]), np.random.default_rng(0))
    tracker, pilot = LaneTracker(lane), Autopilot(car.gains)
    oracle = Oracle(tracker.length)
    fitness, rows, outcome = math.inf, [], Outcome.RUNNING
    for step in range(10_000):
        s = vehicle.state()
        rows.append((s.x, s.y, s.yaw, s.speed))
        lateral, arc = tracker.update(s.x, s.y)
        fitness = min(fitness, road.lane_width / 2 - abs(lateral))
        outcome = oracle.judge(step=step, lateral_distance=road.lane_width / 2 - abs(lateral), arc_length=arc)
        if outcome is not Outcome.RUNNING:
            break
        preview = tracker.lateral_position(s.x + car.preview * math.cos(s.yaw), s.y + car.preview * math.sin(s.yaw))
        vehicle.advance(pilot.command(preview, s.speed))
    return Drive(fitness=fitness, outcome=outcome, path=np.array(rows))


def _bullet(finer: int) -> Vehicle:
    p = BulletParameters()
    return BulletVehicle(dataclasses.replace(p, substeps=finer * p.substeps))


def _softbody(finer: int) -> Vehicle:
    p = SoftbodyParameters()
    return SoftbodyVehicle(
        dataclasses.replace(p, frame_substeps=finer * p.frame_substeps, body_substeps=finer * p.body_substeps)
    )


def _donkey(finer: int) -> Vehicle:
    return _FinerDonkey(finer)


class _FinerDonkey(DonkeyVehicle):
    """The twin with shorter substeps, which are no parameter of the car."""

    def __init__(self, finer: int) -> None:
        super().__init__()
        self._model = CarModel(DonkeyParameters(), substeps=finer * dynamics.SUBSTEPS)
