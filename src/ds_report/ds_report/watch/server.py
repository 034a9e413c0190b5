# SPDX-License-Identifier: Apache-2.0
"""Web server of the page: on this machine only, read only, one page."""

from __future__ import annotations

import asyncio
import errno
import json
import time
from collections.abc import Callable, Collection
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from tornado.httpserver import HTTPServer
from tornado.iostream import IOStream
from tornado.netutil import bind_sockets
from tornado.web import Application, HTTPError, RequestHandler

from ds_base.errors import InputError, RunError
from ds_base.folder_files import StoreError
from ds_orchestrator.campaign.config import ConfigError
from ds_report.camera_pictures import translates
from ds_report.pages import render
from ds_report.watch.campaign_state import CampaignReader, DrivePictures, drive_lines, page_state
from ds_sim.registry import SimulatorName

HOST = "127.0.0.1"
PORT = 8760
"""Chosen: not in IANA's list of services, and beside Foxglove bridge's 8765."""
SHARE = 5.0
"""A reading is shared for this many times its duration, so that it takes a sixth of one processor at most; chosen."""
EVERY = 1.0
"""Least seconds between two readings, however many pages are open; chosen: as often as a page asks."""
MOST_WAITING = 8
"""Drives that wait to be rendered; a further one takes the place of the oldest; chosen: two pages ask for so many."""
_KEPT = 32
"""Rendered drives in memory, 0.1 MB each; chosen: all that a few pages show at once."""
MOST_CONNECTIONS = 100
"""At a time; chosen: fits with all else into 256 descriptors, the usual limit of macOS."""
PATIENCE = 60.0
"""s after which a connection that asks nothing, or does not take its answer, is closed; chosen: a page asks often."""
_POLICY = "default-src 'none'; connect-src 'self'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"


class ServerError(InputError):
    """Server that cannot start."""


class BusyError(RunError):
    """Too many drives are asked for at once."""


class Watched:
    """A campaign whose state and drives are asked for; every method may be called from any coroutine."""

    def __init__(self, reader: CampaignReader, trusted: Collection[str] = ()) -> None:
        self._reader = reader
        self._pictures = DrivePictures(reader.config.driver, trusted)
        self._reading, self._rendering = ThreadPoolExecutor(1), ThreadPoolExecutor(1)
        self._rendered: dict[tuple[str, str, str], asyncio.Future[dict[str, Any]]] = {}
        self._lock = asyncio.Lock()
        self._state, self._until = "", 0.0

    async def state(self) -> str:
        """State of the page as JSON text; if the campaign cannot be read now, its last state and the problem."""
        async with self._lock:
            if time.monotonic() >= self._until:
                began = time.monotonic()
                self._state = await asyncio.get_running_loop().run_in_executor(self._reading, self._read)
                self._until = time.monotonic() + max(EVERY, SHARE * (time.monotonic() - began))
            return self._state

    async def drive(self, test_id: str, simulator: SimulatorName) -> dict[str, Any] | None:
        """A finished drive with its pictures, or None; `BusyError` if newer questions have taken this one's place."""
        loop = asyncio.get_running_loop()
        drive = await loop.run_in_executor(self._reading, self._reader.execution, test_id, simulator)
        if drive is None:
            return None
        key = (test_id, simulator, drive[1].trajectory_sha256)
        rendered = self._rendered.pop(key, None)
        if rendered is None or rendered.cancelled() or (rendered.done() and rendered.exception()):
            rendered = loop.run_in_executor(self._rendering, self._pictures.render, *drive)
        self._rendered[key] = rendered  # the newest is the last
        for old in [key for key, one in self._rendered.items() if one.done()][:-_KEPT]:
            del self._rendered[old]
        for old in [key for key, one in self._rendered.items() if not one.done()][:-MOST_WAITING]:
            self._rendered.pop(old).cancel()
        try:
            pictures = await asyncio.shield(rendered)
        except asyncio.CancelledError:
            raise BusyError from None
        return {**drive_lines(*drive, names=self._reader.config.simulators), "pictures": pictures}

    def close(self) -> None:
        """Release what renders."""
        for waiting in self._rendered.values():
            waiting.cancel()
        self._rendering.submit(self._pictures.close)
        self._rendering.shutdown()
        self._reading.shutdown()

    def _read(self) -> str:
        try:
            state = page_state(self._reader.read())
        except (StoreError, ConfigError, OSError) as error:
            state = {**(json.loads(self._state) if self._state else {}), "problem": " ".join(str(error).split())}
        return json.dumps(state, allow_nan=False)


class _Handler(RequestHandler):
    """Answers GET from pages of this machine; other hosts' names are refused, as in DNS rebinding."""

    def initialize(self, watched: Watched, page: str) -> None:
        self.watched, self.page = watched, page

    def prepare(self) -> None:
        if self.request.host_name not in (HOST, "localhost"):
            raise HTTPError(403, reason="only for pages of this machine")

    def set_default_headers(self) -> None:
        self.set_header("Content-Security-Policy", _POLICY)
        self.set_header("X-Content-Type-Options", "nosniff")
        self.set_header("Cache-Control", "no-store")
        self.clear_header("Server")

    async def answer(self, body: str | dict[str, Any]) -> None:
        """Send the answer; a reader that does not take it is disconnected."""
        try:
            async with asyncio.timeout(PATIENCE):
                await self.finish(body)
        except TimeoutError:
            self.request.connection.stream.close()  # type: ignore[union-attr]


class _Page(_Handler):
    async def get(self) -> None:
        await self.answer(self.page)


class _State(_Handler):
    async def get(self) -> None:
        self.set_header("Content-Type", "application/json")
        await self.answer(await self.watched.state())


class _Drive(_Handler):
    async def get(self) -> None:
        test_id, simulator = (self.get_query_argument(name, "") for name in ("test", "simulator"))
        try:
            drive = await self.watched.drive(test_id, SimulatorName(simulator))
        except StoreError as error:
            raise HTTPError(503, reason="the drive cannot be read now") from error
        except BusyError:
            raise HTTPError(503, reason="too many drives are asked for") from None
        if drive is None:
            raise HTTPError(404, reason="no such drive")
        await self.answer(drive)


class _Server(HTTPServer):
    """Closes the connections that are too many, as without descriptors it could not even refuse them."""

    def handle_stream(self, stream: IOStream, address: tuple[str, int]) -> None:
        if len(self._connections) < MOST_CONNECTIONS:
            super().handle_stream(stream, address)
        else:
            stream.close()


async def serve(
    folder: Path,
    *,
    port: int = PORT,
    trusted: Collection[str] = (),
    ready: Callable[[str], None] = lambda address: None,
) -> None:
    """Serve the page of one campaign until cancelled, on a loopback port, any free one if 0; the folder stays as it is.

    Pictures are rendered by the code of `trusted` user-defined simulators alone; `ready` is called with the address.

    Raises:
        ServerError: the port cannot be used.
        ds_orchestrator.store.sqlite_file.StoreError: the folder holds no campaign.
        ds_orchestrator.campaign.config.ConfigError: its configuration is not valid.
    """
    reader = CampaignReader(folder)
    try:
        sockets = bind_sockets(port, HOST)
    except (OSError, OverflowError) as error:
        taken = getattr(error, "errno", None) == errno.EADDRINUSE
        why = "is in use" if taken else f"cannot be used ({getattr(error, 'strerror', None) or error})"
        raise ServerError(f"port {port} {why}: choose another with --port, or 0 for any free one") from None
    watched = Watched(reader, trusted)
    paired = translates(reader.config.driver)
    page = render("watch.html.j2", config=reader.config, folder=str(reader.folder), paired=paired)
    parts = {"watched": watched, "page": page}
    server = _Server(
        Application(
            [("/", _Page, parts), ("/state.json", _State, parts), ("/drive.json", _Drive, parts)],
            log_function=lambda handler: None,
        ),
        max_body_size=0,
        idle_connection_timeout=PATIENCE,
    )
    server.add_sockets(sockets)
    try:
        ready(f"http://{HOST}:{sockets[0].getsockname()[1]}/")
        await asyncio.Event().wait()
    finally:
        server.stop()
        watched.close()
