# SPDX-License-Identifier: Apache-2.0
"""Answers each message of one client of the Donkey protocol, without sockets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ds_base.progress import logger_of
from ds_road import Road
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.donkey_protocol.messages import (
    FIXED_CAMERA_FIELDS,
    ImageFormat,
    ProtocolError,
    command_of,
    image_format_of,
    number_in,
    telemetry,
)
from ds_sim.scenario import Scenario
from ds_sim.session import Session
from ds_sim.simulator import Command, Observation, Simulator, SimulatorError

LOG = logger_of(__name__)

SCENE = "generated_road"
"""The one scene: the Donkey simulator's with a random road, `donkey-generated-roads-v0` in gym-donkeycar."""
PROTOCOL_VERSION = "2"
AT_REST = Command(0.0, 0.0)
_HAS_NO_EFFECT = {"car_config", "racer_info", "connected", "ping"}
"""Messages about a car's looks and its driver's biography."""


@dataclass(frozen=True, kw_only=True)
class ServedTests:
    """What clients drive: roads one after the other, each with the same seed and conditions.

    Each reset of a client whose car has moved goes on to the next road, the last one to the first.
    """

    roads: Sequence[Road]
    seed: int = 0
    conditions: Conditions = DEFAULT


class Conversation:
    """State of one client, numbered for the log: its own simulator, its road and the format of its images."""

    def __init__(self, simulator: Simulator, tests: ServedTests, client: int = 0) -> None:
        self.ended = False
        self._session = Session(simulator)
        self._tests = tests
        self._client = client
        self._form = ImageFormat()
        self._road = -1
        self._frame: Observation | None = None
        self._command = AT_REST
        self._noted: set[str] = set()

    def greeting(self) -> list[dict[str, Any]]:
        """First messages, before the client says anything."""
        return [{"msg_type": "scene_selection_ready", "loaded": "1"}]

    def answer(self, message: dict[str, Any]) -> list[dict[str, Any]]:
        """Answer a message with others, in their order.

        Raises:
            ProtocolError: the message cannot be answered; the session must end.
            SimulatorError: the simulator failed; the session must end.
        """
        match message["msg_type"]:
            case "control":
                return [self._control(message)]
            case "get_protocol_version":
                return [{"msg_type": "protocol_version", "version": PROTOCOL_VERSION}]
            case "get_scene_names":
                return [{"msg_type": "scene_names", "scene_names": [SCENE]}]
            case "load_scene":
                return self._load_scene(message)
            case "reset_car":
                # The next control's answer shows the car back at the start: an answer of its own would be one too many
                # for a client that counts one per control.
                self._reset()
            case "exit_scene":
                self._frame = None
                return self.greeting()
            case "cam_config":
                self._configure_camera(message)
            case "quit_app":
                self.ended = True
            case kind if kind not in _HAS_NO_EFFECT:
                self._note(f"{kind[:30]!r} has no effect here")
        return []

    def _load_scene(self, message: dict[str, Any]) -> list[dict[str, Any]]:
        name = message.get("scene_name")
        if name != SCENE:
            raise ProtocolError(f"there is no scene {str(name)[:30]!r}: expected {SCENE}")
        self._road = 0
        self._start()
        return [{"msg_type": "car_loaded"}, self._telemetry()]

    def _reset(self) -> None:
        if self._frame is None:
            raise ProtocolError(f"reset_car before a scene was loaded: send load_scene with {SCENE} first")
        if self._frame.step > 0:
            self._road = (self._road + 1) % len(self._tests.roads)
        self._start()

    def _start(self) -> None:
        self._command = AT_REST
        tests = self._tests
        scenario = Scenario(tests.roads[self._road], tests.conditions, seed=tests.seed)
        self._frame = self._checked(self._session.start(scenario))

    def _control(self, message: dict[str, Any]) -> dict[str, Any]:
        if self._frame is None:
            raise ProtocolError(f"control before a scene was loaded: send load_scene with {SCENE} first")
        command, brake = command_of(message)
        # The brake holds a car that has not started: no time passes, so the first frame is that of every other tool.
        held = self._frame.step == 0 and brake > 0
        if self._session.driving and not held:
            self._command = command
            self._frame = self._checked(self._session.advance(command))
            run = self._session.run
            if run is not None and not self._session.driving:
                outcome, steps = run.outcome.name, run.steps
                LOG.info("client %d: %s: %s after %d frames", self._client, run.road.road_id, outcome, steps)
        return self._telemetry()

    def _checked(self, frame: Observation | None) -> Observation:
        if frame is None:
            raise SimulatorError(self._session.run.message if self._session.run is not None else "no run")
        return frame

    def _telemetry(self) -> dict[str, Any]:
        assert self._frame is not None
        return telemetry(self._frame, self._command, self._form)

    def _configure_camera(self, message: dict[str, Any]) -> None:
        self._form = image_format_of(message, self._form)
        asked = [name for name in FIXED_CAMERA_FIELDS if number_in(message, name, 0.0) != 0.0]
        if asked:
            self._note(f"cam_config: {', '.join(asked)} left as they are, the simulator's camera is fixed")

    def _note(self, line: str) -> None:
        if line not in self._noted and len(self._noted) < 20:
            self._noted.add(line)
            LOG.info("client %d: %s", self._client, line)
