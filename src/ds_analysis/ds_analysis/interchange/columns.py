"""Columns of the exported tables, with units and descriptions, which the Parquet files carry too."""

from __future__ import annotations

from typing import NamedTuple

import pyarrow as pa

FORMAT_VERSION = "1"
"""Increases when a column changes its meaning or goes; new columns may come at any time."""


class Column(NamedTuple):
    """A column of an exported table.

    Attributes:
        name: in the file.
        kind: Arrow type.
        unit: SI unit, or "".
        description: one line.
        optional: null where there is no value.
    """

    name: str
    kind: pa.DataType
    unit: str
    description: str
    optional: bool = False


_TEXT, _WHOLE, _REAL = pa.string(), pa.int64(), pa.float64()
_CATEGORY = pa.dictionary(pa.int32(), pa.string())

EXECUTIONS = (
    Column("driver", _CATEGORY, "", "driver under test, as in the configuration"),
    Column("test_id", _TEXT, "", "test: sibling, search run and number"),
    Column("sibling", _CATEGORY, "", "simulator whose search generated the test"),
    Column("run", _WHOLE, "", "index of the search run, from 0"),
    Column("number", _WHOLE, "", "index of the test within its run, from 0"),
    Column("simulator", _CATEGORY, "", "simulator that drove the test"),
    Column("is_twin", pa.bool_(), "", "whether that simulator is the campaign's twin"),
    Column("gate", _CATEGORY, "", "valid, infeasible, out_of_odd, not_applicable; null without gates", True),
    Column("gate_message", _TEXT, "", "why no network can be judged by the test there; null if it can", True),
    Column("outcome", _CATEGORY, "", "COMPLETED, OUT_OF_BOUNDS, STUCK or TIMEOUT; null if excluded", True),
    Column("failed", pa.bool_(), "", "whether the driver failed; null without outcome", True),
    Column("fitness", _REAL, "m", "smallest distance to the edge of the lane, negative outside", True),
    Column("max_lateral_position", _REAL, "m", "largest distance from the lane's centre line", True),
    Column("steps", _WHOLE, "", "frames driven, of 1/20 s", True),
    Column("simulated_seconds", _REAL, "s", "simulated time driven", True),
    Column("message", _TEXT, "", "reason for the outcome where it alone does not explain it", True),
    Column("seed", _WHOLE, "", "seed of every execution of the test"),
    Column("conditions", _TEXT, "", "operating conditions other than the default, as on the command line; else empty"),
    Column("cell", pa.list_(_WHOLE), "", "bins of the feature map, one for each feature; null if none", True),
    Column("road_id", _TEXT, "", "hash of the road"),
    Column("turns_count", _WHOLE, "", "turns of the road"),
    Column("curvature", _REAL, "1/m", "largest curvature of the centre line"),
    Column("length", _REAL, "m", "length of the centre line"),
    Column("lane", _CATEGORY, "", "driven lane: right or left"),
    Column("road", _TEXT, "", "the road as JSON, for ds road and ds drive"),
    Column("bag", _TEXT, "", "folder of the bag below the campaign's, or empty", True),
    Column("trajectory_sha256", _TEXT, "", "digest of the trajectory", True),
)
"""One row for each test on each simulator that drove it, or whose gate excluded it."""

FRAMES = (
    Column("test_id", _CATEGORY, "", "test: sibling, search run and number"),
    Column("simulator", _CATEGORY, "", "simulator that drove the test"),
    Column("step", pa.int32(), "", "frame, from 0 at rest"),
    Column("time", _REAL, "s", "simulated time"),
    Column("x", _REAL, "m", "position in the road frame"),
    Column("y", _REAL, "m", "position in the road frame"),
    Column("yaw", _REAL, "rad", "heading, counter-clockwise from x"),
    Column("speed", _REAL, "m/s", "velocity along the heading"),
    Column("lateral_position", _REAL, "m", "distance from the lane's centre line, right positive"),
    Column("steering", _REAL, "", "command to the next frame, -1 full left to 1 full right; null at the end", True),
)
"""One row for each frame of each execution."""


def schema_of(columns: tuple[Column, ...], **notes: str) -> pa.Schema:
    """Arrow schema whose fields carry unit and description, and whose metadata are the notes."""
    fields = [
        pa.field(c.name, c.kind, nullable=c.optional, metadata={"description": c.description, "unit": c.unit})
        for c in columns
    ]
    return pa.schema(fields, metadata={"format_version": FORMAT_VERSION, **notes})
