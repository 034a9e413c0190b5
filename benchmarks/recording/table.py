# SPDX-License-Identifier: Apache-2.0
"""How well `ds recording locate` finds cars in simulated recordings whose truth is known, as a table.

`python -m benchmarks.recording.table --out FOLDER` takes some five minutes on a core. Offsets count in lane widths.
`--sensors good` gives the cars an encoder and a gyroscope, and locates each recording without and with them.
Settings were fixed beforehand.
"""

from __future__ import annotations

import argparse
import shutil
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from benchmarks.recording.drives import Plan, line_distance, record
from benchmarks.recording.halves import moved
from numpy.typing import NDArray

from ds_driver.data.recordings import Reading
from ds_recording import RecordingError
from ds_recording.floor_camera import read_camera
from ds_recording.locate import located_of
from ds_recording.located import Located, write_located
from ds_recording.recording import read_views
from ds_recording.steering import follow_steering
from ds_recording.track import wrap
from ds_sim.registry import spec_of

Array = NDArray[np.float64]
PLANS = (
    {
        f"{simulator}-{course}-{seed}": Plan(simulator=simulator, seed=seed, course=course)
        for simulator in ("donkey", "panda")
        for course, seed in (("open", 11), ("open", 12), ("open", 13), ("loop", 14))
    }
    | {
        f"{simulator}-blurred-16": Plan(simulator=simulator, seed=16, frames=600, fault="blurred")
        for simulator in ("donkey", "panda")
    }
    | {
        f"donkey-{fault.replace(' ', '-')}": Plan(simulator="donkey", seed=15, frames=500, fault=fault)
        for fault in ("shuffled", "static", "no lines")
    }
)
"""Recordings; no seed was used for development."""
COLUMNS = (
    "offset bias", "offset 95 %", "heading rms", "heading bias", "speed bias", "speed rms", "gain error", "track 95 %",
    "length error", "located", "2 std",
)  # fmt: skip


def main() -> None:
    """Record, locate and compare."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=Path, required=True, help="folder for recordings and results")
    parser.add_argument("--sensors", choices=("good", "bad"), default="", help="record an encoder and a gyroscope, too")
    parser.add_argument("--only", default="", help="part of the recordings' names")
    arguments = parser.parse_args()
    print(f"{'recording':22s} " + " ".join(f"{column:>12s}" for column in COLUMNS) + "   seconds")
    for name, plan in PLANS.items():
        if arguments.only not in name:
            continue
        folder = arguments.out / f"{name}{arguments.sensors and '-'}{arguments.sensors}"
        if not (folder / "truth.csv").exists():
            shutil.rmtree(folder, ignore_errors=True)
            record(replace(plan, sensors=arguments.sensors), folder)
        width = line_distance(spec_of(plan.simulator))
        for odometry in ("none", None) if arguments.sensors else (None,):
            began = time.monotonic()
            label = name if odometry or not arguments.sensors else "  with sensors"
            try:
                views = read_views(folder / "tub", Reading(whole=True), odometry=odometry)
                located, _ = located_of(views, read_camera(folder / "camera.yaml"), width)
            except RecordingError as error:
                print(f"{label:22s} refused: {error}", flush=True)
                continue
            write_located(folder / "located", located)
            values = " ".join(f"{value:12.3f}" for value in compared(located, folder, width))
            print(f"{label:22s} {values} {time.monotonic() - began:9.0f}", flush=True)
            for source in located.about["odometry"]:
                print(f"    {source}", flush=True)


def compared(located: Located, folder: Path, width: float) -> list[float]:
    """Errors against the truth, as `COLUMNS`: lane widths, degrees, shares."""
    truth = np.genfromtxt(folder / "truth.csv", delimiter=",", names=True)
    rows = truth[located.column("frame").astype(int)]
    offset = (located.column("lateral_m") - rows["lateral_m"]) / width
    heading = np.degrees(wrap(located.column("heading_rad") - rows["heading_rad"]))
    moving = rows["speed_mps"] > 1.0
    speed = located.column("speed_mps")[moving] / rows["speed_mps"][moving] - 1.0
    times = located.column("time_s")
    middle = slice(None, -1)
    pair = [
        follow_steering(times, located.column("steering"), speeds[middle] / width, rates[middle])
        for speeds, rates in (
            (located.column("speed_mps"), located.column("yaw_rate_radps")),
            (rows["speed_mps"], rows["yaw_rate_radps"]),
        )
    ]
    gain = pair[0].gain / pair[1].gain - 1.0 if pair[0] and pair[1] else np.nan
    covered = np.abs(offset) <= 2.0 * located.column("std_lateral_m") / width
    return [
        float(np.median(offset)),
        float(np.percentile(np.abs(offset), 95)),
        float(np.sqrt((heading**2).mean())),
        float(np.median(heading)),
        float(np.median(speed)),
        float(np.sqrt((speed**2).mean())),
        gain,
        _track_error(located, rows, folder) / width,
        _driven(located.table[:, 2:4]) / _driven(np.column_stack((rows["x_m"], rows["y_m"]))) - 1.0,
        len(rows) / len(truth),
        float(covered.mean()),
    ]


def _driven(places: Array) -> float:
    """Length of a line through places, (n, 2)."""
    return float(np.hypot(*np.diff(places, axis=0).T).sum())


def _track_error(located: Located, rows: NDArray[np.void], folder: Path) -> float:
    """95% of the distances of the centre line's points from the true one, m, after the best rigid motion."""
    line = np.loadtxt(folder / "track.csv", delimiter=",", skiprows=1)
    true = np.stack((rows["x_m"], rows["y_m"]), axis=1)
    ours = np.stack((located.column("x_m"), located.column("y_m")), axis=1)
    low, high = located.column("along_m").min(), located.column("along_m").max()
    stations = located.track.stations[: len(located.track.points)]
    placed = moved(ours, true, located.track.points[(stations >= low) & (stations <= high)])
    dense = np.concatenate([np.linspace(a, b, 10) for a, b in zip(line[:-1], line[1:], strict=True)])
    away = np.sqrt(((placed[:, None] - dense[None]) ** 2).sum(axis=2).min(axis=1))
    return float(np.percentile(away, 95))


if __name__ == "__main__":
    main()
