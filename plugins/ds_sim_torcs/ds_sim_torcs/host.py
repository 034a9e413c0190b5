# SPDX-License-Identifier: Apache-2.0
"""Process that runs TORCS, and the requests to it; `host/torcs_host.cpp` describes the bytes."""

from __future__ import annotations

import os
import select
import shutil
import struct
import subprocess
import tempfile
import time
import weakref
from collections.abc import Callable
from enum import IntEnum
from pathlib import Path

from ds_base.bounded_file import sha256_of
from ds_base.folder_files import write_whole
from ds_sim.camera.mesa import INSTALL, software_rendering
from ds_sim.simulator import SimulatorError

VERSION = "1.3.7"
"""Version of TORCS whose structures the host knows."""
LIBRARIES = Path("/usr/lib/x86_64-linux-gnu/torcs")
DATA = Path("/usr/share/games/torcs")
"""Where Debian's packages `torcs` and `torcs-data` put libraries and data."""
PACKAGES = "torcs libplib-dev libegl-dev libgl-dev g++ curl xz-utils"
"""Debian's packages with which the host is built and runs."""
OVERRIDE = "DS_TORCS_HOST"
"""Environment variable that names another host."""
SOURCE = Path(__file__).resolve().parents[1] / "host/torcs_host.cpp"
"""Source of the host in a checkout."""
BUILT = Path(__file__).resolve().parents[3] / "build/torcs/torcs_host"
"""Where `make torcs` puts the host of a checkout."""
TIMEOUT = 20.0
"""Seconds within which the host answers; chosen: a hundred times what a road takes."""
_HEAD = struct.Struct("<2I")
_LARGEST = 1 << 24
"""Bytes of an answer that can be one: some pictures."""


class Kind(IntEnum):
    """Kinds of requests and of their answers."""

    ERROR = 0
    HELLO = 1
    CAR = 2
    STEP = 3
    ROAD = 4
    VIEW = 5


def host_program() -> Path:
    """Find the host.

    Raises:
        ImportError: TORCS or the host is missing; one line with what to type.
    """
    program = Path(os.environ.get(OVERRIDE) or BUILT)
    if not (LIBRARIES / "modules/simu/simuv2.so").is_file() or not (DATA / "cars").is_dir():
        raise ImportError(f"TORCS is not installed: sudo apt-get install -y {PACKAGES}, then make torcs")
    if not os.access(program, os.X_OK):
        raise ImportError(f"there is no {program}: in the repository type make torcs, or name a host in {OVERRIDE}")
    return program


class TorcsHost:
    """One process with one car and one world, started by `start` and again after it failed.

    It ends with this object, with this process, and when an answer is late or wrong.

    Args:
        width: columns of the images.
        height: rows of the images.
        timeout: seconds within which an answer must come.

    Raises:
        ImportError: TORCS or the host is missing.
    """

    def __init__(self, width: int, height: int, *, timeout: float = TIMEOUT) -> None:
        self._program = host_program()
        self._size = (width, height)
        self._timeout = timeout
        self._process: subprocess.Popen[bytes] | None = None
        self._end: Callable[[], object] = lambda: None
        self.folder = Path()

    @property
    def pid(self) -> int | None:
        """Number of the process; None where none was started."""
        return self._process.pid if self._process else None

    def start(self) -> None:
        """Start a process unless one runs.

        Raises:
            SimulatorError: it does not start.
        """
        if self._process is not None and self._process.poll() is None:
            return
        self.close()
        self.folder = Path(tempfile.mkdtemp(prefix="ds_torcs_"))
        _lay_out(self.folder)
        environment = {**os.environ, **software_rendering(), "HOME": str(self.folder)}
        try:
            with (self.folder / "log").open("wb") as log:
                process = subprocess.Popen(
                    [self._program, LIBRARIES, *map(str, self._size), self.folder],
                    env=environment,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=log,
                    start_new_session=True,  # Ctrl-C is for this process
                )
        except OSError as error:
            shutil.rmtree(self.folder, ignore_errors=True)
            raise SimulatorError(f"torcs: {self._program} does not start ({error.strerror}): type make torcs") from None
        self._process = process
        self._end = weakref.finalize(self, _stop, process, self.folder, os.getpid())

    def renderer(self) -> str:
        """Version of OpenGL and name of the renderer, such as `4.5 Mesa 22.3.6, llvmpipe (LLVM 15.0.6, 256 bits)`.

        Raises:
            SimulatorError: the host does not start, was built from another source, or draws with another renderer.
        """
        self.start()
        built_from, _, renderer = self.ask(Kind.HELLO).decode(errors="replace").partition("\n")
        if SOURCE.is_file() and not sha256_of([SOURCE]).startswith(built_from or "?"):
            raise SimulatorError(f"torcs: {self._program} was built from another {SOURCE.name}: type make torcs")
        if "llvmpipe" not in renderer:
            raise SimulatorError(f"torcs: the host draws with {renderer}, expected Mesa's llvmpipe: {INSTALL}")
        return renderer

    def ask(self, kind: Kind, request: bytes = b"", *, size: int | None = None) -> bytes:
        """Send a request and return the answer's bytes.

        Args:
            kind: of the request.
            request: its bytes.
            size: number of bytes of the answer; any if None.

        Raises:
            SimulatorError: no process runs, or it ended, hung, refused, or answered nonsense; another one can be
                started.
        """
        process = self._process
        if process is None:
            raise SimulatorError("torcs: no host runs: load a road first")
        try:
            return self._exchange(process, kind, request, size)
        except TimeoutError:
            reason = f"the host did not answer within {self._timeout:g} s"
        except ValueError as error:
            reason = str(error)
        except (EOFError, OSError):
            reason = self._how_it_ended(process)
        self.close()
        raise SimulatorError(f"torcs: {reason}: the next drive starts another host")

    def close(self) -> None:
        """End the process and remove its files; `start` may follow."""
        self._end()
        self._process = None

    def _exchange(self, process: subprocess.Popen[bytes], kind: Kind, request: bytes, size: int | None) -> bytes:
        assert process.stdin is not None and process.stdout is not None
        until = time.monotonic() + self._timeout
        os.write(process.stdin.fileno(), _HEAD.pack(kind, len(request)) + request)  # smaller than a pipe's memory
        answered, length = _HEAD.unpack(_read(process.stdout.fileno(), _HEAD.size, until))
        if answered == Kind.ERROR and length < _LARGEST:
            line = _read(process.stdout.fileno(), length, until).decode(errors="replace")
            raise ValueError(f"the host refuses: {line[:200]}")
        if answered != kind or length > _LARGEST or size not in (None, length):
            wanted = f"{kind.value} of {'any' if size is None else size}"
            raise ValueError(f"the host answered kind {answered} of {length} bytes, expected {wanted}")
        return _read(process.stdout.fileno(), length, until)

    def _how_it_ended(self, process: subprocess.Popen[bytes]) -> str:
        """Status of a process that closed its pipes, and its last line."""
        try:
            status = process.wait(1.0)
        except subprocess.TimeoutExpired:
            return "the host closed its output"
        lines = (self.folder / "log").read_text(errors="replace").strip().splitlines()
        return f"the host ended with status {status} ({lines[-1][:200] if lines else 'it wrote nothing'})"


def _read(source: int, size: int, until: float) -> bytes:
    """Read bytes from a pipe.

    Raises:
        TimeoutError: they do not come in time.
        EOFError: the pipe was closed.
    """
    parts, ready = [], select.poll()
    ready.register(source, select.POLLIN)
    while size > 0:
        if not ready.poll(1000.0 * max(until - time.monotonic(), 0.0)):
            raise TimeoutError
        part = os.read(source, min(size, 1 << 16))
        if not part:
            raise EOFError
        parts.append(part)
        size -= len(part)
    return b"".join(parts)


def _lay_out(folder: Path) -> None:
    """Make the folder that TORCS sees: its own data, and a plane to drive on."""
    for name in ("cars", "categories", "data"):
        (folder / name).symlink_to(DATA / name)
    plane = folder / "tracks/road/plane"
    write_whole(plane / "plane.xml", _PLANE)


def _stop(process: subprocess.Popen[bytes], folder: Path, owner: int) -> None:
    """End the process and remove its files, but not in a fork of its owner."""
    if os.getpid() != owner:
        return
    process.kill()
    process.wait()
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            pipe.close()
    shutil.rmtree(folder, ignore_errors=True)


_PLANE = """<?xml version="1.0" encoding="UTF-8"?>
<!DOCTYPE params SYSTEM "params.dtd">
<params name="plane" type="param" mode="mw">
<section name="Header">
  <attstr name="name" val="plane"/><attstr name="category" val="road"/><attnum name="version" val="4"/>
</section>
<section name="Surfaces"><section name="ds-plane">
  <attnum name="friction" val="1"/><attnum name="rolling resistance" val="0.013"/><attnum name="roughness" val="0"/>
  <attnum name="roughness wavelength" val="1"/>
</section></section>
<section name="Main Track">
  <attnum name="width" val="8000"/><attstr name="surface" val="ds-plane"/>
  <section name="Pits"><attstr name="type" val="none"/></section>
  <section name="Track Segments"><section name="plane">
    <attstr name="type" val="str"/><attnum name="lg" unit="m" val="8000"/>
  </section></section>
</section>
</params>
"""
"""TORCS's track for the physics: one straight as wide as long. Rolling resistance: Gillespie, ch. 4: 0.012 to 0.015."""
