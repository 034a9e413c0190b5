# SPDX-License-Identifier: Apache-2.0
"""Records of the tables of a campaign's store, and their checks: a received file may hold anything."""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Callable, Sequence
from functools import cache
from typing import Annotated, Any, NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, TypeAdapter, ValidationError

from ds_base.config_errors import first_problem
from ds_base.errors import InputError
from ds_road.road import MAX_POINTS
from ds_sim.gates.gate import GateState
from ds_sim.registry import SimulatorName
from ds_sim.simulator import Outcome

MOST_STEPS = 1_000_000
"""Frames of one run; chosen: 500 times the limit of the built-in oracle."""
VERDICTS = tuple(outcome.name for outcome in Outcome if outcome.is_verdict)
_ERRORS = tuple(outcome.name for outcome in Outcome if outcome.is_error)
_COLUMNS = 5


class RowError(InputError):
    """Value that no campaign can have written; the message names table, row and column."""


def _one_of(*words: str) -> Callable[[str], str]:
    def check(value: str) -> str:
        if value not in words:
            raise ValueError(f"{value!r:.60}, expected one of {', '.join(words)}")
        return value

    return check


Text = Annotated[str, Field(strict=True, max_length=10_000)]
"""Message or name; chosen: far longer than the longest one that a campaign writes."""
Simulator = Annotated[SimulatorName, Field(strict=True, max_length=10_000)]
Document = Annotated[str, Field(strict=True, max_length=2**20)]
"""JSON; chosen: a road of 1000 points with all digits takes 50 kB."""
FileName = Annotated[str, Field(strict=True, pattern=r"^[A-Za-z0-9_.-]{1,200}$")]
Digest = Annotated[str, Field(strict=True, pattern="^[0-9a-f]{64}$")]
Bag = Annotated[str, Field(strict=True, max_length=260, pattern=r"^(bags/\.*[A-Za-z0-9_-][A-Za-z0-9_.-]*)?$")]
Count = Annotated[int, Field(strict=True, ge=0)]
Real = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Verdict = Annotated[Text, AfterValidator(_one_of(*VERDICTS))]


class FactRow(NamedTuple):
    """Row of `about`."""

    key: Text
    value: Document


class TestRow(NamedTuple):
    """Row of `tests`; turns and curvature follow from the road, but take most of the time of reading a campaign.

    The curvature is bounded, so that no axis has more bins than memory.
    """

    test_id: FileName
    sibling: Simulator
    run: Count
    number: Count
    road: Document
    road_id: Text
    turns_count: Annotated[int, Field(strict=True, ge=0, le=MAX_POINTS)]
    curvature: Annotated[float, Field(strict=True, ge=0.0, le=1e6)]
    seed: Count
    conditions: Text


class ExecutionRow(NamedTuple):
    """Row of `executions` without its frames."""

    test_id: Text
    simulator: Simulator
    outcome: Verdict
    message: Text
    fitness: Real
    max_lateral_position: Real
    steps: Annotated[int, Field(strict=True, ge=0, le=MOST_STEPS)]
    simulated_seconds: Real
    trajectory_sha256: Digest
    bag: Bag
    rowid: int = 0


class GateRow(NamedTuple):
    """Row of `gates`."""

    test_id: Text
    simulator: Simulator
    state: Annotated[Text, AfterValidator(_one_of(*GateState))]
    message: Text
    outcome: Annotated[Text, AfterValidator(_one_of("", *VERDICTS))]
    visible_contrast: Real
    hidden_share: Real


class ErrorRow(NamedTuple):
    """Attempt that ended in an error."""

    test_id: Text
    simulator: Simulator
    attempt: Count
    outcome: Annotated[Text, AfterValidator(_one_of(*_ERRORS))]
    message: Text


class SearchRow(NamedTuple):
    """Run of a search."""

    sibling: Simulator
    run: Count
    method: Text
    seed: Count


class ResultRow(NamedTuple):
    """Result, and the number of executions and gates from which it was computed."""

    stage: Text
    executions: Annotated[int, Field(strict=True)]


class IdRow(NamedTuple):
    """Row of `given_up`."""

    test_id: Text


class BagRow(NamedTuple):
    """Bag of an execution."""

    bag: Bag


class DriveCount(NamedTuple):
    """Number of executions on a simulator of tests of one search run, by outcome."""

    sibling: Simulator
    run: Count
    simulator: Simulator
    outcome: Verdict
    executions: Count


Record = TypeVar(
    "Record", FactRow, TestRow, ExecutionRow, GateRow, ErrorRow, SearchRow, ResultRow, IdRow, BagRow, DriveCount
)


@cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(list[kind])


def check_rows(kind: type[Record], rows: Sequence[tuple[Any, ...]]) -> list[Record]:
    """Check rows, and name their columns; a `RowError` says why no campaign can have written one."""
    try:
        return cast("list[Record]", _adapter(cast(Any, kind)).validate_python(rows))
    except ValidationError as error:
        row, column = error.errors(include_url=False)[0]["loc"][:2]
        key = ", ".join(f"{value!r:.60}" for value in rows[int(row)][:2])
        raise RowError(f"the row of {key}: {first_problem(error, kind._fields[int(column)])}") from None


def pack_numbers(values: NDArray[np.float64]) -> bytes:
    """Compress numbers for the store."""
    return zlib.compress(values.tobytes())


def unpack_numbers(packed: object, name: str, *, count: int) -> NDArray[np.float64]:
    """Decompress what `pack_numbers` wrote to a column, with memory bounded by the expected count.

    RowError if the value is damaged, holds another number of values, or one that is not finite.
    """
    if not isinstance(packed, bytes):
        raise RowError(f"{name} is no blob")
    expected = 8 * count
    unpacker = zlib.decompressobj()
    try:
        content = unpacker.decompress(packed, expected + 1)
        if len(content) == expected and not unpacker.eof:
            content += unpacker.decompress(unpacker.unconsumed_tail, 1)
    except zlib.error:
        raise RowError(f"{name} is damaged") from None
    if len(content) != expected or not unpacker.eof or unpacker.unused_data:
        raise RowError(f"{name} does not hold {count} numbers")
    values = np.frombuffer(content, dtype=np.float64)
    if not np.isfinite(values).all():
        raise RowError(f"{name} holds NaN or infinity")
    return values


def unpack_trajectory(packed: object, digest: str, *, steps: int) -> NDArray[np.float64]:
    """Decompress a trajectory, (steps + 1, 5), or (0, 5) for a run without observations, and check its digest.

    RowError if it is damaged, of another length, not finite, or has another digest.
    """
    empty = steps == 0 and digest == trajectory_sha256(np.empty((0, _COLUMNS)))
    rows = 0 if empty else steps + 1
    trajectory = unpack_numbers(packed, "trajectory", count=_COLUMNS * rows).reshape(rows, _COLUMNS)
    if trajectory_sha256(trajectory) != digest:
        raise RowError("trajectory does not match its stored SHA-256")
    return trajectory


def trajectory_sha256(trajectory: NDArray[np.float64]) -> str:
    """SHA-256 over the little-endian float64 bytes of x, y, yaw and speed, the first columns of (n, 4 or more)."""
    return hashlib.sha256(np.ascontiguousarray(trajectory[:, :4], dtype="<f8").tobytes()).hexdigest()
