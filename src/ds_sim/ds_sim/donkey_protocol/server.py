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
from collections.abc import Callable
from typing import Any

from ds_base.errors import InputError
from ds_base.progress import logger_of
from ds_sim.donkey_protocol.conversation import SCENE, Conversation, ServedTests
from ds_sim.donkey_protocol.messages import MessageSplitter, ProtocolError
from ds_sim.registry import SimulatorName, make_simulator
from ds_sim.simulator import Simulator, SimulatorError

LOG = logger_of(__name__)

CHUNK = 64 * 1024
GREETING_DELAY = 0.5
"""s from the connection to the first message. gym-donkeycar drops what arrives before its constructor has returned, and
then waits forever; chosen: long for that, on a busy machine too."""

YIELDS_AFTER = 30.0
"""s without a complete message after which a client gives its place to a new one, if all are taken; chosen: far longer
than a network computes, so that only clients that hang or pause lose theirs."""


class DonkeyServerError(InputError):
    """The server cannot listen."""


class DonkeyServer:
    """Serves a simulator to clients of the Donkey protocol; what each drives are `tests`, from the first road on.

    A client may take `patience` s of the wall clock for a whole message, or for reading an answer.
    """

    def __init__(
        self,
        simulator: SimulatorName,
        tests: ServedTests,
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
        """Serve until cancelled.

        Args:
            host: address to listen on.
            port: 0 for any free one.
            listening: is called with the port once clients can connect.

        Raises:
            ServerError: the address cannot be used.
            ds_sim.registry.UnknownSimulatorError: no simulator has this name.
            ds_sim.NotApplicableError: the simulator cannot realise a condition.
            ds_sim.simulator.SimulatorError: the simulator cannot load a road.
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
        await self._send(writer, conversation.greeting())
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
