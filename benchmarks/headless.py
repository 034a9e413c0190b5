"""Closed loop of vehicle, lane and autopilot without camera and ROS, which depends on the physics alone."""

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
from ds_sim.parts import Vehicle
from ds_sim.simulator import FRAME_TIME, AutopilotGains, Outcome
from ds_sim_bullet import simulator as bullet
from ds_sim_bullet.parameters import BulletParameters
from ds_sim_bullet.vehicle import BulletVehicle
from ds_sim_panda.vehicle import parameters as panda
from ds_sim_panda.vehicle.multi_body import MultiBodyVehicle
from ds_sim_panda.vehicle.parameters import MultiBodyParameters
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
    """Result of one run.

    Attributes:
        fitness: smallest lateral distance, m (paper 3.3).
        outcome: how it ended.
        path: (steps + 1, 4) x, y, yaw, speed in road metres, including the start.
    """

    fitness: float
    outcome: Outcome
    path: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Car:
    """Vehicle that can be made with finer substeps, and settings of its autopilot.

    Attributes:
        make: makes a vehicle whose number of substeps is a multiple of the nominal one.
        gains: gains of its autopilot.
        preview: distance of the autopilot's preview point ahead of the car's centre, m.
        substep: nominal substep, s.
    """

    make: Callable[[int], Vehicle]
    gains: AutopilotGains
    preview: float
    substep: float


def cars() -> dict[str, Car]:
    """The four vehicles, by name of their simulator."""
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
        "panda": Car(
            make=_panda,
            gains=panda.GAINS,
            preview=panda.PREVIEW_DISTANCE,
            substep=FRAME_TIME / MultiBodyParameters().substeps,
        ),
        "donkey": Car(
            make=_donkey,
            gains=donkey.GAINS,
            preview=donkey.PREVIEW_DISTANCE,
            substep=FRAME_TIME / dynamics.SUBSTEPS,
        ),
    }


def drive(car: Car, vehicle: Vehicle, road: Road) -> Drive:
    """Let the autopilot drive a road until the run ends, as `ds_sim.road_simulator` would."""
    lane = road.lane_centre
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


def _panda(finer: int) -> Vehicle:
    p = MultiBodyParameters()
    return MultiBodyVehicle(dataclasses.replace(p, substeps=finer * p.substeps, stable_step=p.stable_step / finer))


def _donkey(finer: int) -> Vehicle:
    return _FinerDonkey(finer)


class _FinerDonkey(DonkeyVehicle):
    """Twin with shorter substeps, which are not a parameter of the car."""

    def __init__(self, finer: int) -> None:
        super().__init__()
        self._model = CarModel(DonkeyParameters(), substeps=finer * dynamics.SUBSTEPS)
