# SPDX-License-Identifier: Apache-2.0
"""How well a fitted twin says, from commands alone, where a located car is half a second later.

`python -m benchmarks.recording.ahead LOCATED [REST]` fits the twin to a recording that `ds recording locate` has
located and predicts windows of REST, or fits to three fifths and predicts windows of the others: offset from the road's
centre line, from each window's smoothed state, beside the nominal twin and a car that keeps its offset. What was found
is smoothed over time, commands included, so errors of the recording's own location do not show.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ds_recording.located import Located, read_located
from ds_recording.track import Track
from ds_twin_donkey.dynamics import SUBSTEPS
from ds_twin_donkey.fit import Mounting, fit_located
from ds_twin_donkey.logs import LogSegment, read_log
from ds_twin_donkey.parameters import DonkeyParameters
from ds_twin_donkey.windows import RUN_IN, Windows

Array = NDArray[np.float64]
AHEAD = 10
"""Frames ahead: half a second."""
FITTED_SHARE = 0.6
LONGEST_DELAY = 0.6
"""Longest delay of a predicted car, s; the same windows for all."""


def offsets(track: Track, places: Array) -> Array:
    """Offset to the right of the centre line, m."""
    near = np.array([np.argmin(np.hypot(*(track.points - place).T)) for place in places])
    return track.place(places, track.nearest(places, near))[1]


def split(drives: Sequence[LogSegment], share: float) -> tuple[list[LogSegment], list[LogSegment]]:
    """The first part of drives, a share of their rows, and the rest."""
    left = int(share * sum(len(drive.commands) for drive in drives))
    first: list[LogSegment] = []
    rest: list[LogSegment] = []
    for drive in drives:
        cut = min(left, len(drive.commands))
        left -= cut
        for part, chosen in ((first, slice(0, cut)), (rest, slice(cut, None))):
            if len(drive.commands[chosen]) > 2:
                part.append(
                    LogSegment(commands=drive.commands[chosen], measured=drive.measured[chosen], from_rest=False)
                )
    return first, rest


def main() -> None:
    """Fit, predict and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("located", type=Path)
    parser.add_argument("rest", type=Path, nargs="?")
    arguments = parser.parse_args()
    drives = read_log(arguments.located).drives
    if arguments.rest:
        compare(drives, read_log(arguments.rest).drives, read_located(arguments.rest))
    else:
        compare(*split(drives, FITTED_SHARE), read_located(arguments.located))


def compare(drives: Sequence[LogSegment], rest: Sequence[LogSegment], located: Located) -> None:
    """Fit to some drives, predict the rest, whose road is in `located`, and print errors."""
    nominal = DonkeyParameters()
    fitted, mounting = fit_located(drives)
    for estimate in fitted.estimates:
        print(f"{estimate.name:20s} {estimate.value:9.4f} [{estimate.low:.4f}, {estimate.high:.4f}] {estimate.status}")
    print(f"poses {mounting.forward:.3f} m ahead of the centre, turned by {mounting.yaw:.4f} rad")
    seconds = (AHEAD - RUN_IN + 1) * 0.05
    windows = Windows(rest, nominal, seconds, 1e9, LONGEST_DELAY)
    whole = windows.known[:, -1, :2].all(axis=1)
    states = windows.initial_states
    then = offsets(located.track, windows.measured[whole, -1, :2])
    now = offsets(located.track, states[whole, :2])
    errors = {}
    cars = {"fitted": (fitted.parameters, mounting), "nominal": (nominal, Mounting())}
    for name, (car, point) in (cars | {"nominal, poses as found": (nominal, mounting)}).items():
        begin = point.to_car(states)
        predicted = point.to_pose(windows.predict([car], begin[None], SUBSTEPS)[0])
        errors[name] = offsets(located.track, predicted[whole, -1, :2]) - then
    errors["keeps its offset"] = now - then
    errors["goes on straight"] = offsets(located.track, _straight(states[whole])) - then
    print(f"{int(whole.sum())} windows; error of the offset after half a second, lane widths: rms, median, 95%")
    for name, error in errors.items():
        size = np.abs(error) / located.lane_width
        print(f"{name:30s} {np.sqrt((size**2).mean()):.3f} {np.median(size):.3f} {np.quantile(size, 0.95):.3f}")


def _straight(states: Array) -> Array:
    """Where cars are half a second later that keep speed and heading."""
    way = states[:, 3] * AHEAD * 0.05
    return np.column_stack((states[:, 0] + way * np.cos(states[:, 2]), states[:, 1] + way * np.sin(states[:, 2])))


if __name__ == "__main__":
    main()
