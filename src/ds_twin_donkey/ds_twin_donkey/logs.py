# SPDX-License-Identifier: Apache-2.0
"""Reads recorded drives for the fit: bags of this project, Donkey Car tubs (version 2), tables; 20 Hz, model metres."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ds_bags.donkey_tub import TubError, is_tub, read_tub
from ds_bags.layout import BagError, printable
from ds_bags.reader import STATE, BagReader, states_and_commands
from ds_base.bounded_file import FileError, read_regular, sha256_of
from ds_base.errors import InputError
from ds_base.words import multiple
from ds_sim.registry import simulators
from ds_sim.simulator import FRAME_TIME
from ds_twin_donkey.parameters import SCALE

Array = NDArray[np.float64]
CHANNELS = ("x", "y", "yaw", "speed", "yaw_rate")
"""Fitted quantities: position (m) and heading (rad) of the car's centre, forward speed (m/s), yaw rate (rad/s)."""
TABLE = "located.csv"
"""Name of the table in a folder that `ds recording locate` wrote."""
_TABLE_COLUMNS = ("time_s", "steering", "throttle", "x_m", "y_m", "yaw_rad", "speed_mps", "yaw_rate_radps")
"""Columns of a table; of the last five it may have some only."""
_LOCATED_ONLY = "std_lateral_m"
"""Column that only a located recording has."""
LARGEST_TABLE = 2**26
"""Bytes of a table; chosen: half a million rows, seven hours."""
MAX_GAP = 0.25
"""Largest time between two rows, s; chosen: five frames. A longer gap ends a drive, as its commands are unknown."""
_MAX_JITTER = 0.002
"""Largest deviation of the row spacing from one frame that needs no resampling, s; chosen: less than a substep."""
_MIN_COMPARED_SPEED, _MAX_SPEED_RATIO = 0.3, 1.5
"""Speed (m/s) above which positions and speed must agree, and the largest ratio between them. Chosen: above the noise
of positions; more than the error of a wheel sensor, less than that of wrong units (positions and speeds of the Donkey
simulator have differed by a factor of 8)."""
_STANDING_SPEED = 0.05
"""Speed below which a drive counts as started from rest, model m/s; chosen: above the noise of a speed sensor."""


class LogError(InputError):
    """A log cannot be read, or nothing can be fitted to it."""


@dataclass(frozen=True, kw_only=True)
class LogSegment:
    """Part of a log without gaps."""

    commands: Array  # (n, 2) steering and throttle; row i is applied at frame i and held until frame i + 1
    measured: Array  # (n, 5) measurements, columns as `CHANNELS`, model metres; NaN where the log has no value
    from_rest: bool  # True if the car stood still with neutral commands before the first row


@dataclass(frozen=True, kw_only=True)
class Log:
    """One recorded log."""

    name: str  # name of the file or folder
    kind: str  # `bag`, `tub`, `table`, or `located` for a table that `ds recording locate` wrote
    sha256: str  # SHA-256 over the files that were read, one after the other
    drives: tuple[LogSegment, ...]  # parts without gaps

    @property
    def seconds(self) -> float:
        """Total length of all drives, s."""
        return sum(len(drive.commands) for drive in self.drives) * FRAME_TIME


def read_log(path: Path) -> Log:
    """Read a folder with a bag of one run, a Donkey Car tub or a located recording, or a table; else LogError."""
    if (path / "metadata.yaml").is_file():
        return _read_bag(path)
    if is_tub(path):
        return _read_tub(path)
    if (path / TABLE).is_file() or path.suffix == ".csv":
        return _read_table(path if path.suffix == ".csv" else path / TABLE)
    if not path.exists():
        raise LogError(f"{path}: no such log: name the folder of a bag or of a Donkey Car tub")
    raise LogError(
        f"{path}: no bag (metadata.yaml), Donkey Car tub (manifest.json) or located recording ({TABLE}): "
        "give such a folder"
    )


def drives_of(times: Array, commands: Array, measured: Array) -> tuple[LogSegment, ...]:
    """Cut a log at gaps and at reverse throttle, which the twin does not model, and resample each part to 20 Hz.

    Times are in s, increasing; commands and measurements are (n, 2) and (n, 5) as in `LogSegment`.
    """
    usable = np.isfinite(commands).all(axis=1) & (commands[:, 1] >= 0.0)
    cuts = np.flatnonzero((np.diff(times) > MAX_GAP) | (np.diff(times) <= 0.0)) + 1
    drives = []
    for block in np.split(np.arange(len(times)), cuts):
        edges = np.flatnonzero(np.diff(usable[block])) + 1
        drives += [
            _resampled(times[part], commands[part], measured[part])
            for part in np.split(block, edges)
            if len(part) > 1 and usable[part[0]]
        ]
    return tuple(drives)


def _resampled(times: Array, commands: Array, measured: Array) -> LogSegment:
    measured = measured.copy()
    measured[~np.isfinite(measured)] = np.nan
    has_yaw = np.isfinite(measured[:, 2])
    measured[has_yaw, 2] = np.unwrap(measured[has_yaw, 2])  # a single NaN would invalidate all later values
    if np.abs(np.diff(times) - FRAME_TIME).max() > _MAX_JITTER:
        grid = np.arange(times[0], times[-1] + 1e-9, FRAME_TIME)
        # Commands are held until the next one; measurements are interpolated linearly.
        commands = commands[np.searchsorted(times, grid + 1e-9, side="right") - 1]
        measured = np.column_stack([np.interp(grid, times, column) for column in measured.T])
    first = measured[:3]
    speed = first[:, 3] if np.isfinite(first[:, 3]).all() else np.hypot(*np.diff(first[:, :2], axis=0).T) / FRAME_TIME
    return LogSegment(commands=commands, measured=measured, from_rest=bool(np.median(np.abs(speed)) < _STANDING_SPEED))


def _read_bag(path: Path) -> Log:
    states: dict[int, tuple[float, ...]] = {}
    commands_by_stamp: dict[int, tuple[float, float]] = {}
    try:
        with BagReader(path) as bag:
            simulator = bag.facts.get("simulator", "")
            if simulator in simulators() and simulator != "donkey":
                raise LogError(
                    f"{path}: a drive of {simulator}, which is not a 1:16 car: give drives of the car that is fitted"
                )
            files = bag.files
            if (vehicles := len(bag.of_type(STATE))) > 1:
                raise LogError(f"{path}: states of {vehicles} runs, which would be mixed: give bags of one run")
            for is_command, stamp, message in states_and_commands(bag):
                if is_command:
                    commands_by_stamp[stamp] = float(message.steering), float(message.throttle)
                else:
                    states[stamp] = tuple(float(getattr(message, name)) for name in CHANNELS)
    except BagError as error:
        raise LogError(str(error)) from None
    except (AttributeError, TypeError, ValueError, OverflowError) as error:
        if isinstance(error, LogError):
            raise
        raise LogError(f"{path}: a message has unexpected fields ({printable(error)}): record it again") from None
    stamps = sorted(states.keys() & commands_by_stamp.keys())
    if len(stamps) < 2:
        raise LogError(
            f"{path}: {len(states)} states and {len(commands_by_stamp)} commands, with {len(stamps)} stamps in common: "
            "give a bag recorded by `ds drive --bag` or a campaign"
        )
    measured = np.array([states[s] for s in stamps], dtype=np.float64)
    measured[:, [0, 1, 3]] /= SCALE
    commands = np.array([commands_by_stamp[s] for s in stamps], dtype=np.float64)
    return Log(
        name=path.name,
        kind="bag",
        sha256=sha256_of(sorted(files)),
        drives=drives_of(np.array(stamps) / 1e9, commands, measured),
    )


def _check_commands(path: Path, commands: Array) -> None:
    missing = [name for k, name in enumerate(("steering", "throttle")) if not np.isfinite(commands[:, k]).any()]
    if missing:
        raise LogError(
            f"{path}: no record has {' or '.join(missing)}, without which nothing is known of how the car answers: "
            "record user/angle and user/throttle of a tub, or commands of a bag, too"
        )


def _read_tub(path: Path) -> Log:
    try:
        tub = read_tub(path)
    except TubError as error:
        raise LogError(str(error)) from None
    times = tub.seconds
    columns = {
        "x": tub.numbers("pos/pos_x"),
        # Unity's axes are left-handed with y up. Seen from above, x points right and z ahead, so a left turn is
        # counter-clockwise, as in the road frame.
        "y": tub.numbers("pos/pos_z"),
        "speed": tub.numbers("pos/speed", "enc/speed"),
    }
    if not (np.isfinite(columns["x"]) & np.isfinite(columns["y"])).any() and not np.isfinite(columns["speed"]).any():
        raise LogError(
            f"{path}: the tub has neither positions (pos/pos_x, pos/pos_z) nor speed (pos/speed, enc/speed): "
            "no motion can be fitted: record them too, or find them with `ds recording locate`"
        )
    if not np.isfinite(times).all():
        raise LogError(f"{path}: _timestamp_ms of a record is not a number: remove that record")
    _check_units(path, times, columns)
    _check_commands(path, tub.commands)
    measured = np.full((len(times), len(CHANNELS)), np.nan)
    for name, column in columns.items():
        measured[:, CHANNELS.index(name)] = column
    return Log(name=path.name, kind="tub", sha256=sha256_of(tub.files), drives=drives_of(times, tub.commands, measured))


def _read_table(path: Path) -> Log:
    """Read a CSV file with a line of names, such as `ds recording locate` and motion capture write."""
    try:
        text = read_regular(path, LARGEST_TABLE).decode()
        head, *lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
        rows = np.array(
            [[float(value) if value else np.nan for value in line.split(",")] for line in lines], dtype=np.float64
        )
        columns = dict(zip([name.strip() for name in head.split(",")], rows.T, strict=True))
        times, steering, throttle = (columns[name] for name in _TABLE_COLUMNS[:3])
    except (OSError, FileError, ValueError, KeyError) as error:
        reason = (
            f"it has no column {error}" if isinstance(error, KeyError) else getattr(error, "strerror", None) or error
        )
        expected = ", ".join(_TABLE_COLUMNS)
        raise LogError(
            f"{path}: {printable(str(reason))}: expected a line of names and numbers below ({expected})"
        ) from None
    measured = np.column_stack([columns.get(name, np.full(len(times), np.nan)) for name in _TABLE_COLUMNS[3:]])
    if not np.isfinite(times).all() or not np.isfinite(measured).any():
        raise LogError(
            f"{path}: time_s, or all of {', '.join(_TABLE_COLUMNS[3:])}, are no numbers: record the motion, too"
        )
    commands = np.column_stack((steering, throttle)).clip(-1.0, 1.0)
    _check_commands(path, commands)
    kind = "located" if _LOCATED_ONLY in columns else "table"
    return Log(name=path.name, kind=kind, sha256=sha256_of([path]), drives=drives_of(times, commands, measured))


def _check_units(path: Path, times: Array, columns: dict[str, Array]) -> None:
    with np.errstate(all="ignore"):
        pace = np.hypot(np.diff(columns["x"]), np.diff(columns["y"])) / np.diff(times)
        speed = 0.5 * (columns["speed"][1:] + columns["speed"][:-1])
        ratio = pace / speed
    ratio = ratio[np.isfinite(ratio) & ((speed > _MIN_COMPARED_SPEED) | (pace > _MIN_COMPARED_SPEED))]
    if ratio.size and not 1.0 / _MAX_SPEED_RATIO < np.median(ratio) < _MAX_SPEED_RATIO:
        raise LogError(
            f"{path}: according to its positions the car is {multiple(float(np.median(ratio)))} as fast as "
            "its speed says: record both in metres of the car"
        )
