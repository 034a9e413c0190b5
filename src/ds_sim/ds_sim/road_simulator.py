# SPDX-License-Identifier: Apache-2.0
"""Base class of simulators: combines a vehicle model and a scene, which is all a new simulator provides."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ds_road import Road, RoadError
from ds_sim.camera.rendered_scene import PaintedScene
from ds_sim.conditions.actuation import COMMAND_CONDITIONS, Actuation
from ds_sim.conditions.model import DEFAULT, FIELDS, Conditions
from ds_sim.oracle import LaneTracker, Oracle, OracleLimits
from ds_sim.parts import Scene, Vehicle
from ds_sim.simulator import (
    FRAME_TIME,
    Command,
    LaneState,
    Observation,
    Outcome,
    Simulator,
    SimulatorError,
    SimulatorSpec,
)


def start_of(road: Road) -> tuple[float, float, float]:
    """Pose of a vehicle at the start of the driven lane: x, y (m) and yaw (rad) in the road frame."""
    lane = road.lane_centre
    ahead = lane[1] - lane[0]
    return float(lane[0, 0]), float(lane[0, 1]), math.atan2(ahead[1], ahead[0])


class RoadSimulator(Simulator):
    """Implements `ds_sim.simulator.Simulator` for any vehicle model.

    Args:
        spec: description of the simulator; `conditions` is filled in from what vehicle and scene realise.
        vehicle: physics model.
        scene: what the camera sees; a `PaintedScene` of the spec's camera and look if omitted.
        limits: thresholds that end a run; the defaults of `OracleLimits` if omitted.
    """

    takes_stills = True

    def __init__(
        self,
        spec: SimulatorSpec,
        vehicle: Vehicle,
        *,
        scene: Scene | None = None,
        limits: OracleLimits | None = None,
    ) -> None:
        self.vehicle = vehicle
        self.scene = scene or PaintedScene(spec.camera, spec.look)
        realised = COMMAND_CONDITIONS | vehicle.conditions | self.scene.conditions
        self._spec = replace(spec, conditions=tuple(name for name in FIELDS if name in realised))
        self.limits = limits or OracleLimits()
        self._run: _Run | None = None

    @property
    def spec(self) -> SimulatorSpec:
        """Description of this simulator."""
        return self._spec

    def draw_rows(self, top: int, bottom: int) -> None:
        """Draw only some rows of the images of the runs to come; see `Simulator.draw_rows`."""
        self.scene.draw_rows(top, bottom)

    def draw_images(self, wanted: bool) -> None:
        """Leave out images; see `Simulator.draw_images`."""
        self.scene.drawing = wanted

    def still(self) -> NDArray[np.uint8]:
        """Take an image without noise and latency; see `Simulator.still`."""
        return self.scene.still(self.vehicle.state())

    def load(self, road: Road, *, seed: int, conditions: Conditions = DEFAULT) -> Observation:
        """Build the world from scratch; see `Simulator.load`."""
        self._run = None
        self._spec.check(conditions)
        if not road.validity.valid:
            raise RoadError(f"road {road.road_id} is not valid: {road.validity.reason}")
        vehicle_seed, sensor_seed = np.random.SeedSequence(seed).spawn(2)
        self.vehicle.adjust(friction=conditions.friction, payload=conditions.payload)
        self.vehicle.reset(*start_of(road), np.random.default_rng(vehicle_seed))
        tracker, acts = LaneTracker(road.lane_centre), COMMAND_CONDITIONS & conditions.changed.keys()
        self.scene.load(road, np.random.default_rng(sensor_seed), conditions.for_scene(self.scene.conditions))
        run = _Run(
            tracker=tracker,
            oracle=Oracle(tracker.length, self.limits),
            half_lane=road.lane_width / 2,
            actuation=Actuation(conditions, self._spec.max_steering_angle) if acts else None,
        )
        self._run = run
        return self._observe(run)

    def step(self, command: Command) -> Observation:
        """Advance by one step; see `Simulator.step`."""
        run = self._run
        if run is None:
            raise SimulatorError(f"{self._spec.name}: no road is loaded: load one first")
        if run.outcome is not Outcome.RUNNING:
            raise SimulatorError(
                f"{self._spec.name}: the run has ended ({run.outcome.name}): load a road to start another"
            )
        if run.actuation is not None:
            command = run.actuation.reached(command, run.speed)
        self.vehicle.advance(command)
        run.step += 1
        return self._observe(run)

    def unload(self) -> None:
        """Forget the road; see `Simulator.unload`."""
        self._run = None
        self.scene.unload()

    def close(self) -> None:
        """Release the simulator's resources."""
        self._run = None
        self.scene.close()
        self.vehicle.close()

    def _observe(self, run: _Run) -> Observation:
        state = self.vehicle.state()
        pose = (state.x, state.y, state.yaw, state.roll, state.pitch, state.heave)
        if not all(math.isfinite(v) for v in (*pose, state.speed, state.lateral_speed, state.yaw_rate)):
            self._run = None
            raise SimulatorError(f"{self._spec.name}: the physics diverged at step {run.step}: a state is not finite")
        run.speed = state.speed
        lateral, arc = run.tracker.update(state.x, state.y)
        ahead = self._spec.preview_distance
        preview = run.tracker.lateral_position(
            state.x + ahead * math.cos(state.yaw), state.y + ahead * math.sin(state.yaw)
        )
        lane = LaneState(
            lateral_position=lateral,
            lateral_distance=run.half_lane - abs(lateral),
            preview_lateral_position=preview,
            arc_length=arc,
        )
        run.outcome = run.oracle.judge(step=run.step, lateral_distance=lane.lateral_distance, arc_length=arc)
        return Observation(
            image=self.scene.image(state),
            step=run.step,
            time=run.step * FRAME_TIME,
            vehicle=state,
            lane=lane,
            outcome=run.outcome,
        )


@dataclass(kw_only=True)
class _Run:
    """State of one run on one road."""

    tracker: LaneTracker
    oracle: Oracle
    half_lane: float
    actuation: Actuation | None
    speed: float = 0.0
    step: int = 0
    outcome: Outcome = Outcome.RUNNING
