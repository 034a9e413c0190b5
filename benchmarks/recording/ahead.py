"""How well a fitted twin says, from commands alone, where a located car is half a second later.

`python -m benchmarks.recording.ahead LOCATED` fits the twin to the first three fifths of a recording that `ds recording
locate` has located, and predicts windows of the rest, each from its smoothed state: offset from the road's centre line,
beside the nominal twin and a car that keeps its offset. What was found is smoothed over time, commands included, so
errors of the recording's own location do not show.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ds_recording.located import read_located
from ds_recording.track import Track
from ds_twin_donkey.dynamics import SUBSTEPS
from ds_twin_donkey.fit import fit
from ds_twin_donkey.logs import Drive, read_log
from ds_twin_donkey.parameters import DonkeyParameters
from ds_twin_donkey.residuals import MAX_FACTOR
from ds_twin_donkey.windows import RUN_IN, Windows

Array = NDArray[np.float64]
AHEAD = 10
"""Frames ahead: half a second."""
FITTED_SHARE = 0.6


def offsets(track: Track, places: Array) -> Array:
    """Offset to the right of the centre line, m."""
    near = np.array([np.argmin(np.hypot(*(track.points - place).T)) for place in places])
    return track.place(places, track.nearest(places, near))[1]


def main() -> None:
    """Fit, predict and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("located", type=Path)
    folder = parser.parse_args().located
    located, drives = read_located(folder), read_log(folder).drives
    left = FITTED_SHARE * sum(len(drive.commands) for drive in drives)
    first: list[Drive] = []
    rest: list[Drive] = []
    for drive in drives:
        cut = min(max(int(left), 0), len(drive.commands))
        left -= cut
        for part, chosen in ((first, slice(0, cut)), (rest, slice(cut, None))):
            if len(drive.commands[chosen]) > 2:
                part.append(Drive(commands=drive.commands[chosen], measured=drive.measured[chosen], from_rest=False))
    nominal = DonkeyParameters()
    found = fit(first, nominal, say=print)
    for estimate in found.estimates:
        print(f"{estimate.name:20s} {estimate.value:9.4f} [{estimate.low:.4f}, {estimate.high:.4f}] {estimate.status}")
    seconds = (AHEAD - RUN_IN + 1) * 0.05
    windows = Windows(rest, nominal, seconds, 1e9, MAX_FACTOR * nominal.command_delay)
    known = windows.known[:, -1, :2].all(axis=1)
    then = offsets(located.track, windows.measured[known, -1, :2])
    now = offsets(located.track, windows.initial_states[known, :2])
    gain = replace(nominal, max_steering_angle=found.parameters.max_steering_angle)
    cars = {"fitted": found.parameters, "nominal": nominal, "nominal with the fitted gain": gain}
    predicted = windows.predict(list(cars.values()), np.repeat(windows.initial_states[None], len(cars), 0), SUBSTEPS)
    errors = {name: offsets(located.track, predicted[k, known, -1, :2]) - then for k, name in enumerate(cars)}
    errors["keeps its offset"] = now - then
    errors["goes on straight"] = offsets(located.track, _straight(windows.initial_states[known])) - then
    print(f"{int(known.sum())} windows; error of the offset after half a second, lane widths: rms, median, 95 %")
    for name, error in errors.items():
        size = np.abs(error) / located.lane_width
        print(f"{name:30s} {np.sqrt((size**2).mean()):.3f} {np.median(size):.3f} {np.quantile(size, 0.95):.3f}")


def _straight(states: Array) -> Array:
    """Where cars are half a second later that keep speed and heading."""
    way = states[:, 3] * AHEAD * 0.05
    return np.column_stack((states[:, 0] + way * np.cos(states[:, 2]), states[:, 1] + way * np.sin(states[:, 2])))


if __name__ == "__main__":
    main()
