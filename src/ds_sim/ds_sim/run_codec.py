# SPDX-License-Identifier: Apache-2.0
"""Encodes a run as bytes, to send it from one process or machine to another; every number keeps its bits.

Layout, little-endian: a header (magic, version, outcome, reason, number of frames, of commands and of bytes of the
message, CRC-32); one column after the other of float64 (time, vehicle, lane), of uint32 (step) and of uint8 (outcome)
over the frames, and of float64 over the commands (steering, throttle); the message as UTF-8. Version 2, of runs whose
lines were measured, has before the message the number of contrasts, uint32, and the contrasts, float64. The road, the
seed and the conditions are not sent, since the receiver has asked for them, but the CRC-32 covers them.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable
from dataclasses import fields
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from ds_base.errors import InputError
from ds_sim.conditions.text import format_conditions
from ds_sim.scenario import Scenario
from ds_sim.session import NO_IMAGE, RunRecord
from ds_sim.simulator import Command, LaneState, Observation, Outcome, Reason, VehicleState

VERSION, MEASURED_VERSION = 1, 2
"""Versions of the layout, without and with contrasts of the lines; another one is refused."""
MAX_FRAMES = 1_000_000
"""Frames of one run; chosen: 500 times the limit of the built-in oracle, as the store has it."""
MAX_MESSAGE = 64 * 1024
"""Bytes of a run's message; chosen: far above the longest line that a simulator has given."""
_MAGIC = b"DSRN"
_HEADER = struct.Struct("<4sHBBIIII")
_COUNT = struct.Struct("<I")
_CHECKSUM_SIZE = 4
_VEHICLE = tuple(field.name for field in fields(VehicleState))
_LANE = tuple(field.name for field in fields(LaneState))
_FLOATS = ("time", *(f"vehicle.{name}" for name in _VEHICLE), *(f"lane.{name}" for name in _LANE))
_COMMAND = tuple(field.name for field in fields(Command))
_FRAME_SIZE = 8 * len(_FLOATS) + 4 + 1
_COMMAND_SIZE = 8 * len(_COMMAND)


class RunCodecError(InputError):
    """A run that cannot be encoded, or bytes that are no encoded run."""


def encode_run(run: RunRecord) -> bytes:
    """Encode a run; about 124 bytes a frame, 16 a command.

    Raises:
        RunCodecError: a number is not finite or does not fit, or the run is longer than `MAX_FRAMES`.

    Examples:
        >>> from ds_road import Road
        >>> from ds_sim import Session, decode_run, encode_run, make_simulator
        >>> road = Road([(125, 0), (125, 25), (125, 50), (125, 75)])
        >>> session = Session(make_simulator("softbody"))
        >>> _ = session.start(road, seed=1)
        >>> run = session.run
        >>> decode_run(encode_run(run), run.scenario) == run
        True
    """
    frames, commands = len(run.observations), len(run.commands)
    try:
        message = run.message.encode()
        _check_counts(frames, commands, len(message))
        floats = _table(map(attrgetter(*_FLOATS), run.observations), _FLOATS, frames)
        driven = _table(map(attrgetter(*_COMMAND), run.commands), _COMMAND, commands)
        body = b"".join(
            (
                floats.tobytes(),
                np.array([seen.step for seen in run.observations], "<u4").tobytes(),
                bytes(seen.outcome for seen in run.observations),
                driven.tobytes(),
                _measured(run),
                message,
            )
        )
        version = MEASURED_VERSION if run.visible_contrasts else VERSION
        head = (_MAGIC, version, run.outcome, run.reason, frames, commands, len(message))
        start = _HEADER.pack(*head, 0)[:-_CHECKSUM_SIZE]
    except RunCodecError:
        raise
    except (ValueError, OverflowError, TypeError, struct.error) as error:
        raise RunCodecError(f"the run of road {run.road.road_id} cannot be sent: {error}") from None
    return start + struct.pack("<I", _checksum(start, body, run.scenario)) + body


def decode_run(data: bytes, scenario: Scenario) -> RunRecord:
    """Decode a run that `encode_run` encoded; memory is bounded by the size of the data.

    Args:
        data: the whole encoded run.
        scenario: what was driven.

    Raises:
        RunCodecError: the data is damaged, or of another version, road, seed or conditions.
    """
    if len(data) < _HEADER.size:
        raise RunCodecError(f"a run of {len(data)} bytes, expected {_HEADER.size} or more: it was cut off")
    magic, version, outcome, reason, frames, commands, length, checksum = _HEADER.unpack_from(data)
    if magic != _MAGIC:
        raise RunCodecError(f"a run starts with {bytes(magic)!r}, expected {_MAGIC!r}: this is something else")
    if version not in (VERSION, MEASURED_VERSION):
        raise RunCodecError(
            f"a run of version {version}, expected {VERSION} or {MEASURED_VERSION}: install the same version on both "
            "sides"
        )
    _check_counts(frames, commands, length)
    driven = _HEADER.size + _FRAME_SIZE * frames + _COMMAND_SIZE * commands
    size = driven + length
    if version == MEASURED_VERSION:
        contrasts = _COUNT.unpack_from(data, driven)[0] if len(data) >= driven + _COUNT.size else 0
        size += _COUNT.size + 8 * contrasts
    if len(data) != size:
        raise RunCodecError(f"a run of {len(data)} bytes, expected {size}: it was cut off, or something follows it")
    start, body = data[: _HEADER.size - _CHECKSUM_SIZE], data[_HEADER.size :]
    if _checksum(start, body, scenario) != checksum:
        raise RunCodecError(
            "a run has a wrong checksum: it is damaged, or of another road, seed or conditions, send it again"
        )
    try:
        run = RunRecord(scenario=scenario, outcome=Outcome(outcome))
        return _record(body, frames, commands, run, reason, measured=version == MEASURED_VERSION)
    except RunCodecError:
        raise
    except ValueError as error:  # an outcome, reason or command that does not exist, or text that is not UTF-8
        raise RunCodecError(f"a run makes no sense ({error}): install the same version on both sides") from None


def _record(body: bytes, frames: int, commands: int, run: RunRecord, reason: int, *, measured: bool) -> RunRecord:
    floats = np.frombuffer(body, "<f8", frames * len(_FLOATS)).reshape(len(_FLOATS), frames)
    at = floats.nbytes
    steps = np.frombuffer(body, "<u4", frames, at)
    at += steps.nbytes
    outcomes = [Outcome(value) for value in body[at : at + frames]]
    at += frames
    driven = np.frombuffer(body, "<f8", commands * len(_COMMAND), at).reshape(len(_COMMAND), commands)
    at += driven.nbytes
    _check_finite(floats, _FLOATS)
    if measured:
        (count,) = _COUNT.unpack_from(body, at)
        contrasts = np.frombuffer(body, "<f8", count, at + _COUNT.size)
        _check_finite(contrasts[None], ("visible_contrast",))
        run.visible_contrasts.extend(contrasts.tolist())
        at += _COUNT.size + contrasts.nbytes
    pose = len(_VEHICLE)
    for step, outcome, (time, *values) in zip(
        steps.tolist(), outcomes, zip(*floats.tolist(), strict=True), strict=True
    ):
        vehicle = VehicleState(**dict(zip(_VEHICLE, values[:pose], strict=True)))
        lane = LaneState(**dict(zip(_LANE, values[pose:], strict=True)))
        run.observations.append(
            Observation(image=NO_IMAGE, step=step, time=time, vehicle=vehicle, lane=lane, outcome=outcome)
        )
    run.commands.extend(map(Command, *driven.tolist()))
    run.reason = Reason(reason)
    run.message = str(body[at:], "utf-8")
    return run


def _measured(run: RunRecord) -> bytes:
    """Contrasts of the lines with their number; nothing if they were not measured."""
    if not run.visible_contrasts:
        return b""
    contrasts = _table(
        ((contrast,) for contrast in run.visible_contrasts), ("visible_contrast",), len(run.visible_contrasts)
    )
    return _COUNT.pack(len(run.visible_contrasts)) + contrasts.tobytes()


def _check_counts(frames: int, commands: int, message: int) -> None:
    if frames > MAX_FRAMES or message > MAX_MESSAGE:
        raise RunCodecError(
            f"a run has {frames} frames and a message of {message} bytes, "
            f"expected at most {MAX_FRAMES} and {MAX_MESSAGE}"
        )
    if commands != max(0, frames - 1):
        raise RunCodecError(f"a run has {frames} frames and {commands} commands, expected one command between two")


def _table(rows: Iterable[tuple[float, ...]], names: tuple[str, ...], count: int) -> NDArray[np.float64]:
    """One row per name, of the values of all frames or commands, (names, count)."""
    columns = np.array(list(rows), "<f8").reshape(count, len(names)).T
    _check_finite(columns, names)
    return columns


def _check_finite(columns: NDArray[np.float64], names: tuple[str, ...]) -> None:
    finite = np.isfinite(columns)
    if not finite.all():
        name, index = np.argwhere(~finite)[0]
        raise RunCodecError(f"{names[name]} is {columns[name, index]} in frame {index}, expected a finite number")


def _checksum(start: bytes, body: bytes, scenario: Scenario) -> int:
    test = " ".join(filter(None, (scenario.road.road_id, str(scenario.seed), format_conditions(scenario.conditions))))
    return zlib.crc32(body, zlib.crc32(start, zlib.crc32(test.encode())))
