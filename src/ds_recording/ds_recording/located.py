# SPDX-License-Identifier: Apache-2.0
"""Result of locating a recording, and its four files.

Frame of reference: x and y in the plane of the floor, yaw counter-clockwise (REP-103), with the first image near the
origin, heading along x. Offsets are from the centre line of the ROAD, which is the yellow line between its two
lanes, to the right positive, as `ds_sim.oracle.LaneTracker` has it for whatever line it is given.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ds_base.bounded_file import FileError, read_json, read_regular
from ds_base.folder_files import enter_folder, write_json, write_whole
from ds_recording import RecordingError
from ds_recording.floor_camera import FloorCamera, read_camera, write_camera
from ds_recording.track import Track, read_track, write_track
from ds_road.road import abbreviated

Array = NDArray[np.float64]
COLUMNS = (
    "frame", "time_s", "x_m", "y_m", "yaw_rad", "along_m", "lateral_m", "heading_rad", "speed_mps", "yaw_rate_radps",
    "std_lateral_m", "std_heading_rad", "steering", "throttle",
)  # fmt: skip
"""Columns of `located.csv`; steering and throttle are empty where the recording has none."""
LOCATED, TRACK, CAMERA, ABOUT = "located.csv", "track.csv", "camera.yaml", "recording.json"
MAX_FILE = 2**27
"""Largest file that is read, bytes; chosen: a million rows."""


@dataclass(frozen=True, kw_only=True)
class Located:
    """Where the car was."""

    table: Array  # a row for each located image, columns as `COLUMNS`, (n, 14); NaN where a command is unknown
    track: Track  # centre line of the road, m
    lane_width: float  # from the middle of the centre line to the middle of an edge line, m
    camera: FloorCamera
    about: dict[str, Any]  # contents of `recording.json`

    def column(self, name: str) -> Array:
        """One column of the table, (n,)."""
        return self.table[:, COLUMNS.index(name)]


def write_located(folder: Path, located: Located) -> None:
    """Write the four files into a folder, which is created if missing."""
    enter_folder(folder)
    lines = [",".join(COLUMNS)]
    for frame, *values in located.table.tolist():
        lines.append(",".join([str(int(frame)), *("" if value != value else f"{value:.6g}" for value in values)]))
    write_whole(folder / LOCATED, "\n".join(lines) + "\n")
    write_track(folder / TRACK, located.track, located.lane_width)
    write_camera(folder / CAMERA, located.camera)
    write_json(folder / ABOUT, located.about)


def read_located(folder: Path) -> Located:
    """Read a folder that `write_located` wrote; RecordingError if a file is missing, damaged or of another form."""
    try:
        about = read_json(folder / ABOUT, MAX_FILE)
        header, *rows = read_regular(folder / LOCATED, MAX_FILE).decode().splitlines()
        if tuple(header.split(",")) != COLUMNS:
            raise ValueError(f"{LOCATED} has the columns {header[:80]}, expected {','.join(COLUMNS)}")
        table = np.array([[float(v) if v else np.nan for v in row.split(",")] for row in rows])
        if table.ndim != 2 or table.shape[1] != len(COLUMNS) or not np.isfinite(table[:, :-2]).all():
            raise ValueError(f"{LOCATED} needs a row of {len(COLUMNS)} numbers for each image")
        if not isinstance(about, dict):
            raise ValueError(f"{ABOUT} is no object")
        width = about.get("lane_width_m")
        if isinstance(width, bool) or not isinstance(width, int | float) or not 0.0 < width < 1e3:
            raise ValueError(f"lane_width_m in {ABOUT} is {abbreviated(width)}, expected metres")
    except (OSError, ValueError, FileError) as error:
        reason = getattr(error, "strerror", None) or error
        raise RecordingError(f"{folder}: {reason!s:.200}: give a folder that `ds recording locate` wrote") from None
    track, camera = read_track(folder / TRACK), read_camera(folder / CAMERA)
    return Located(table=table, track=track, lane_width=float(width), camera=camera, about=about)
