# SPDX-License-Identifier: Apache-2.0
"""Gymnasium environment: drive a road from camera images, on any simulator of the project.

Importing this module registers `DigitalSiblings-v0`; `docs/python_api.md` shows how it is used.
"""

from __future__ import annotations

from typing import Any, SupportsFloat

import numpy as np
from numpy.typing import NDArray

from ds_base.installation import install_command
from ds_road import Road, generate
from ds_sim.camera.spec import IMAGE_HEIGHT, IMAGE_WIDTH
from ds_sim.registry import make_simulator
from ds_sim.simulator import FRAME_RATE, Command, Observation, Outcome, SimulatorError

try:
    import gymnasium
    from gymnasium import spaces
except ImportError as missing:
    raise ImportError(
        f"ds_sim.gym_env needs Gymnasium, an optional package. Type: {install_command('gym')}"
    ) from missing

ENVIRONMENT_ID = "DigitalSiblings-v0"
FAILURE_REWARD = -1.0
"""Reward of the frame in which a run fails (gym-donkeycar's reward for leaving the track)."""


class DigitalSiblingsEnv(gymnasium.Env[NDArray[np.uint8], NDArray[np.float32]]):
    """One road per episode, driven at 20 frames per simulated second.

    **Observation**: the camera image, `Box(0, 255, (160, 320, 3), uint8)`, RGB.

    **Action**: `Box([-1, 0], [1, 1], float32)`: steering, -1 full left to +1 full right, and throttle, 0 to 1.

    **Reward**: `progress * (1 - |lateral position| / half a lane)`, where progress is the distance covered along the
    lane's centre line in this frame, in m. This is gym-donkeycar's reward, speed weighted by how close the car is to
    the centre of its lane, integrated over a frame. The frame in which the car fails gives -1.

    **Termination**: the road was completed, or the car left its lane (`OUT_OF_BOUNDS`) or got stuck (`STUCK`).

    **Truncation**: 2000 frames passed (`TIMEOUT`).

    **Info**: `outcome`, `road_id`, `simulator_seed`, `time` (s), `speed` (m/s), `lateral_position` (m, right
    positive), `lateral_distance` (m, to the edge of the lane) and `arc_length` (m along the lane's centre line).

    **Reset**: `options={"road": Road(...)}` chooses the road and `options={"simulator_seed": 7}` the seed of the sensor
    noise; what is left out is drawn from `seed`. The same seed, options and actions give the same bytes.

    Args:
        simulator: known simulator, or `module:Class`.
        max_angle: largest angle between two control-point segments of a random road, degrees.
        render_mode: `rgb_array` lets `render` return the latest camera image.

    Raises:
        ds_sim.registry.UnknownSimulatorError: no simulator has this name.
        ValueError: unknown render mode.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": int(FRAME_RATE)}

    def __init__(self, simulator: str = "donkey", *, max_angle: int = 120, render_mode: str | None = None) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode is {render_mode!r}, expected None or 'rgb_array'")
        self.render_mode = render_mode
        self.observation_space = spaces.Box(0, 255, (IMAGE_HEIGHT, IMAGE_WIDTH, 3), np.uint8)
        self.action_space = spaces.Box(np.array([-1.0, 0.0], np.float32), np.array([1.0, 1.0], np.float32))
        self._max_angle = max_angle
        self._simulator = make_simulator(simulator)
        self._road: Road | None = None
        self._simulator_seed = 0
        self._last: Observation | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.uint8], dict[str, Any]]:
        """Put the car at rest at the start of a road.

        Args:
            seed: of the random road and of the sensor noise; None goes on with the generator.
            options: `road` (a valid `ds_road.Road`) and `simulator_seed` (int), both optional.

        Raises:
            ValueError: unknown option, or a value of the wrong type.
            ds_road.RoadError: the road is not valid.
        """
        super().reset(seed=seed)
        chosen = dict(options or {})
        road, simulator_seed = chosen.pop("road", None), chosen.pop("simulator_seed", None)
        if chosen:
            raise ValueError(f"unknown option {', '.join(map(repr, chosen))}: expected road or simulator_seed")
        if not (road is None or isinstance(road, Road)):
            raise ValueError(f"option road is a {type(road).__name__}, expected a ds_road.Road")
        if not (simulator_seed is None or (isinstance(simulator_seed, int) and simulator_seed >= 0)):
            raise ValueError(f"option simulator_seed is {simulator_seed!r}, expected a whole number from 0 on")
        self._road = generate(self.np_random, max_angle=self._max_angle) if road is None else road
        drawn = int(self.np_random.integers(2**31)) if simulator_seed is None else simulator_seed
        self._simulator_seed = drawn
        self._last = self._simulator.load(self._road, seed=drawn)
        return self._last.image.copy(), self._info(self._last)

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.uint8], SupportsFloat, bool, bool, dict[str, Any]]:
        """Hold a steering and a throttle for one frame, 1/20 s.

        Raises:
            ds_sim.simulator.CommandError: the action is not finite or outside the action space.
            ds_sim.simulator.SimulatorError: `reset` was not called, the episode has ended, or the physics broke.
        """
        if self._last is None or self._road is None:
            raise SimulatorError("no episode is under way: call reset first")
        before = self._last
        observation = self._last = self._simulator.step(Command(float(action[0]), float(action[1])))
        progress = observation.lane.arc_length - before.lane.arc_length
        centred = 1.0 - abs(observation.lane.lateral_position) / (self._road.lane_width / 2)
        failed = observation.outcome in (Outcome.OUT_OF_BOUNDS, Outcome.STUCK)
        return (
            observation.image.copy(),  # a camera with latency delivers one image several times
            FAILURE_REWARD if failed else progress * centred,
            failed or observation.outcome is Outcome.COMPLETED,
            observation.outcome is Outcome.TIMEOUT,
            self._info(observation),
        )

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]
        """Return a copy of the latest camera image, (160, 320, 3) uint8 RGB; None without `render_mode`."""
        if self.render_mode is None or self._last is None:
            return None
        return self._last.image.copy()

    def close(self) -> None:
        """Release the simulator."""
        self._last = None
        self._simulator.close()

    def _info(self, observation: Observation) -> dict[str, Any]:
        assert self._road is not None
        return {
            "outcome": observation.outcome.name,
            "road_id": self._road.road_id,
            "simulator_seed": self._simulator_seed,
            "time": observation.time,
            "speed": observation.vehicle.speed,
            "lateral_position": observation.lane.lateral_position,
            "lateral_distance": observation.lane.lateral_distance,
            "arc_length": observation.lane.arc_length,
        }


if ENVIRONMENT_ID not in gymnasium.registry:
    gymnasium.register(id=ENVIRONMENT_ID, entry_point=f"{__name__}:{DigitalSiblingsEnv.__name__}")
