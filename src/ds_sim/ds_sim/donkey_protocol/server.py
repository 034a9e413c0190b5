# SPDX-License-Identifier: Apache-2.0
"""TCP server: one simulator for each client, all in one process.

Simulators take turns at each frame, so several clients share one core; for more, start several servers. Whatever a
client does, at most its own session ends.
"""

from __future__ import annotations

import asyncio
import errno
import json
import time
from collections.abc import Callable, Sequence
from typing import Any

from ds_base.errors import InputError
from ds_base.progress import logger_of
from ds_sim.donkey_protocol.messages import (
    FIXED_CAMERA_FIELDS,
    ImageFormat,
    MessageSplitter,
    ProtocolError,
    command_of,
    image_format_of,
    number_in,
    telemetry,
)
from ds_sim.registry import SimulatorName, make_simulator
from ds_sim.scenario import Scenario
from ds_sim.session import Session
from ds_sim.simulator import Command, Observation, Simulator, SimulatorError

LOG = logger_of(__name__)

SCENE = "generated_road"
"""The one scene: the Donkey simulator's with a random road, `donkey-generated-roads-v0` in gym-donkeycar."""
PROTOCOL_VERSION = "2"
GREETING = {"msg_type": "scene_selection_ready", "loaded": "1"}
"""First message, before the client says anything."""
AT_REST = Command(0.0, 0.0)
_HAS_NO_EFFECT = {"car_config", "racer_info", "connected", "ping"}
"""Messages about a car's looks and its driver's biography."""
CHUNK = 64 * 1024
GREETING_DELAY = 0.5
"""s from the connection to the first message. gym-donkeycar drops what arrives before its constructor has returned, and
then waits forever; chosen: long for that, on a busy machine too."""
YIELDS_AFTER = 30.0
"""s without a complete message after which a client gives its place to a new one, if all are taken; chosen: far longer
than a network computes, so that only clients that hang or pause lose theirs."""


class Conversation:
    """Answers each message of one client, numbered for the log, without sockets.

    Each reset of a client whose car has moved goes on to the next of the tests, the last one to the first.
    """

    def __init__(self, simulator: Simulator, tests: Sequence[Scenario], client: int = 0) -> None:
        self.ended = False
        self._session = Session(simulator)
        self._tests = tests
        self._client = client
        self._form = ImageFormat()
        self._test = 0
        self._frame: Observation | None = None
        self._command = AT_REST
        self._noted: set[str] = set()

    def answer(self, message: dict[str, Any]) -> list[dict[str, Any]]:
        """Answer a message with others, in their order; a ProtocolError or SimulatorError must end the session."""
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
                return [GREETING]
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
        self._test = 0
        self._start()
        return [{"msg_type": "car_loaded"}, self._telemetry()]

    def _reset(self) -> None:
        if self._frame is None:
            raise ProtocolError(f"reset_car before a scene was loaded: send load_scene with {SCENE} first")
        if self._frame.step > 0:
            self._test = (self._test + 1) % len(self._tests)
        self._start()

    def _start(self) -> None:
        self._command = AT_REST
        self._frame = self._checked(self._session.start(self._tests[self._test]))

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


class DonkeyServerError(InputError):
    """The server cannot listen."""


class DonkeyServer:
    """Serves a simulator to clients of the Donkey protocol; what each drives are `tests`, from the first road on.

    A client may take `patience` s of the wall clock for a whole message, or for reading an answer.
    """

    def __init__(
        self,
        simulator: SimulatorName,
        tests: Sequence[Scenario],
        *,
        patience: float = 600.0,
        most_clients: int = 8,
        greeting_delay: float = GREETING_DELAY,
        yields_after: float = YIELDS_AFTER,
    ) -> None:
        self._simulator = simulator
        self._tests = tests
        self._patience = patience
        self._most = most_clients
        self._greeting_delay = greeting_delay
        self._yields_after = yields_after
        self._idle: list[Simulator] = []
        self._heard: dict[int, float] = {}
        """Client -> time of its last complete message, s."""
        self._seats: dict[int, asyncio.Task[None]] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._served = 0

    async def serve(self, host: str, port: int, listening: Callable[[int], None]) -> None:
        """Serve until cancelled, on a port, 0 for any free one; `listening` gets it once clients can connect.

        An address that cannot be used, and a simulator that cannot load the first test, are errors.
        """
        self._warm_up()
        try:
            server = await asyncio.start_server(self._connected, host, port)
        except OSError as error:
            raise DonkeyServerError(_listening_problem(error, host, port)) from None
        try:
            listening(server.sockets[0].getsockname()[1])
            await asyncio.get_running_loop().create_future()  # never done: until cancelled
        finally:
            server.close()
            for task in self._tasks:
                task.cancel()
            await asyncio.gather(*self._tasks)
            for simulator in self._idle:
                simulator.close()

    def _warm_up(self) -> None:
        """Load the first road: an unusable simulator is refused at once, and what compiles on first use is ready."""
        simulator = make_simulator(self._simulator)
        self._idle.append(simulator)
        Conversation(simulator, self._tests).answer({"msg_type": "load_scene", "scene_name": SCENE})

    def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.get_running_loop().create_task(self._serve_client(reader, writer))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _serve_client(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._served += 1
        number = self._served

        if len(self._seats) >= self._most and not self._make_room():
            LOG.info("client %d: %s", number, problem := f"refused, as {self._most} clients are connected")
            await self._close(writer, problem)
            return
        task = asyncio.current_task()
        assert task is not None
        self._seats[number], self._heard[number] = task, time.monotonic()
        LOG.info("client %d: connected", number)
        simulator, problem = None, ""
        try:
            simulator = self._idle.pop() if self._idle else make_simulator(self._simulator)
            await self._converse(reader, writer, Conversation(simulator, self._tests, number), number)
        except ProtocolError as error:
            problem = str(error)
        except (SimulatorError, ValueError) as error:
            problem = f"the simulator failed: {error}"
            if simulator is not None:
                simulator.close()
                simulator = None
        except TimeoutError:
            problem = f"silent for {self._patience:g} s"
        except OSError:  # the client vanished
            pass
        except asyncio.CancelledError:
            problem = "the server stops" if number in self._seats else "a new client takes the place"
        finally:
            self._seats.pop(number, None)
            self._heard.pop(number, None)
            if simulator is not None:
                self._idle.append(simulator)
        LOG.info("client %d: disconnected%s%s", number, ": " if problem else "", problem)
        await self._close(writer, problem)

    def _make_room(self) -> bool:
        """Disconnect the client that has been silent longest, if that is long."""
        silent = min(self._seats, key=lambda number: self._heard[number])
        if time.monotonic() - self._heard[silent] < self._yields_after:
            return False
        self._seats.pop(silent).cancel()
        return True

    async def _converse(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, conversation: Conversation, number: int
    ) -> None:
        """Answer until the client leaves."""
        splitter = MessageSplitter()
        await asyncio.sleep(self._greeting_delay)
        await self._send(writer, [GREETING])
        while not conversation.ended:
            messages: list[dict[str, Any]] = []
            async with asyncio.timeout(self._patience):  # for a whole message, however many pieces it comes in
                while not messages:
                    if not (data := await reader.read(CHUNK)):
                        return
                    messages = splitter.feed(data)
            self._heard[number] = time.monotonic()
            for message in messages:
                await self._send(writer, conversation.answer(message))
                await asyncio.sleep(0)  # the other clients' turn
                if conversation.ended:
                    return

    async def _send(self, writer: asyncio.StreamWriter, messages: list[dict[str, Any]]) -> None:
        for message in messages:
            writer.write(json.dumps(message, allow_nan=False).encode() + b"\n")
        async with asyncio.timeout(self._patience):
            await writer.drain()

    async def _close(self, writer: asyncio.StreamWriter, problem: str) -> None:
        """Close a connection, with the reason for the client if there is one."""
        try:
            if problem:
                writer.write(json.dumps({"msg_type": "error", "message": problem}).encode() + b"\n")
            writer.close()
            async with asyncio.timeout(1.0):
                await writer.wait_closed()
        except (OSError, TimeoutError):
            writer.transport.abort()


def _listening_problem(error: OSError, host: str, port: int) -> str:
    if error.errno == errno.EADDRINUSE:
        return f"port {port} of {host} is in use: choose another with --port, or 0 for any free one"
    if error.errno == errno.EACCES:
        return f"port {port} needs privileges: choose one from 1024 on with --port"
    reason = (error.strerror or str(error)).splitlines()[0]
    return f"cannot listen on {host}, port {port} ({reason}): check --host"
