# SPDX-License-Identifier: Apache-2.0
"""Encodes a run as JSON, to send it from one process or machine to another; every number keeps its bits.

The road is not sent, since the receiver has asked for it: the identity of the test is.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from operator import attrgetter
from typing import Annotated, Any, NamedTuple

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from ds_base.errors import InputError
from ds_sim.conditions.text import format_conditions
from ds_sim.scenario import Scenario
from ds_sim.session import NO_IMAGE, RunRecord
from ds_sim.simulator import Command, LaneState, Observation, Outcome, Reason, VehicleState

MAX_FRAMES = 1_000_000
"""Frames of one run; chosen: 500 times the limit of the built-in oracle, as the store has it."""
MAX_MESSAGE = 64 * 1024
"""Characters of a run's message; chosen: far above the longest line that a simulator has given."""
_FRAME_FIELDS = ("step", "time", "vehicle", "lane", "outcome")
_RUN_FIELDS = ("outcome", "reason", "message", "commands", "visible_contrasts")


class RunCodecError(InputError):
    """A run that cannot be encoded, or bytes that are no encoded run."""


class _Frame(NamedTuple):
    """Observation without its image."""

    step: Annotated[int, Field(ge=0)]
    time: float
    vehicle: VehicleState
    lane: LaneState
    outcome: Outcome


class _Run(NamedTuple):
    test: str
    frames: Annotated[list[_Frame], Field(max_length=MAX_FRAMES)]
    outcome: Outcome
    reason: Reason
    message: Annotated[str, Field(max_length=MAX_MESSAGE)]
    commands: Annotated[list[Command], Field(max_length=MAX_FRAMES)]
    visible_contrasts: Annotated[list[float], Field(max_length=MAX_FRAMES)]


_DECODER = TypeAdapter(_Run, config=ConfigDict(strict=True))
_MEMBERS = {kind: attrgetter(*kind.__dataclass_fields__) for kind in (VehicleState, LaneState, Command)}


def _plain(value: Any) -> Any:
    """What `json` does not know: states and commands as their fields, numbers of NumPy as those of Python."""
    kind = type(value)
    if kind in _MEMBERS:
        return dict(zip(kind.__dataclass_fields__, _MEMBERS[kind](value), strict=True))
    return value.item()


_ENCODER = json.JSONEncoder(default=_plain, separators=(",", ":"))


def encode_run(run: RunRecord) -> bytes:
    """Encode a run; about 500 bytes a frame.

    Raises:
        RunCodecError: a number is not finite or no number, or the run is longer than `MAX_FRAMES`.

    Examples:
        >>> from ds_road import Road
        >>> from ds_sim import Scenario, Session, decode_run, encode_run, make_simulator
        >>> road = Road([(125, 0), (125, 25), (125, 50), (125, 75)])
        >>> session = Session(make_simulator("softbody"))
        >>> _ = session.start(Scenario(road, seed=1))
        >>> run = session.run
        >>> decode_run(encode_run(run), run.scenario) == run
        True
    """
    try:
        _check(run)
        frames = [_Frame(*values) for values in map(attrgetter(*_FRAME_FIELDS), run.observations)]
        return _ENCODER.encode(_Run(_test_of(run.scenario), frames, *attrgetter(*_RUN_FIELDS)(run))).encode()
    except (TypeError, AttributeError, OverflowError) as error:  # a simulator of a user may give anything as a number
        raise RunCodecError(f"the run of road {run.road.road_id} cannot be sent: {error}") from None


def decode_run(data: bytes, scenario: Scenario) -> RunRecord:
    """Decode a run that `encode_run` encoded; memory is bounded by the size of the data.

    Args:
        data: the whole encoded run.
        scenario: what was driven.

    Raises:
        RunCodecError: the data is damaged, or of another road, seed or conditions.
    """
    try:
        sent = _DECODER.validate_json(data)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        reason = " ".join(f"{'.'.join(map(str, first['loc']))}: {first['msg']}".split())
        raise RunCodecError(f"a run cannot be read ({reason}): send it again, from the same version") from None
    if sent.test != _test_of(scenario):
        raise RunCodecError("a run is of another road, seed or conditions: send it again")
    frames = [Observation(image=NO_IMAGE, **frame._asdict()) for frame in sent.frames]
    values = {name: getattr(sent, name) for name in _RUN_FIELDS}
    run = RunRecord(scenario=scenario, observations=frames, **values)
    _check(run)
    return run


def _test_of(scenario: Scenario) -> str:
    return f"{scenario.road.road_id} {scenario.seed} {format_conditions(scenario.conditions)}"


def _check(run: RunRecord) -> None:
    frames, commands = len(run.observations), len(run.commands)
    if frames > MAX_FRAMES or len(run.message) > MAX_MESSAGE:
        raise RunCodecError(
            f"a run has {frames} frames and a message of {len(run.message)} characters, "
            f"expected at most {MAX_FRAMES} and {MAX_MESSAGE}"
        )
    if commands != max(0, frames - 1):
        raise RunCodecError(f"a run has {frames} frames and {commands} commands, expected one command between two")
    for name, index, value in _numbers(run):
        if not math.isfinite(value):
            raise RunCodecError(f"{name} is {value} in frame {index}, expected a finite number")


_FLOATS = (
    "time",
    *(f"vehicle.{name}" for name in VehicleState.__dataclass_fields__),
    *(f"lane.{name}" for name in LaneState.__dataclass_fields__),
)


def _numbers(run: RunRecord) -> Iterator[tuple[str, int, float]]:
    """Name, frame and value of each number whose type does not bound it."""
    for index, values in enumerate(map(attrgetter(*_FLOATS), run.observations)):
        for name, value in zip(_FLOATS, values, strict=True):
            yield name, index, value
    for index, value in enumerate(run.visible_contrasts):
        yield "visible_contrast", index, value
