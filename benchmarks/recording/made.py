# SPDX-License-Identifier: Apache-2.0
"""Cars with known parameters, recorded, located and fitted: what is recovered, and what it predicts.

`python -m benchmarks.recording.made --out FOLDER` takes some three minutes a car on a core. The cars are the 1:16 car
with other parameters, all at once, from a seeded generator; no seed was used for development. The delay that is found
contains the camera's.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
from benchmarks.recording.ahead import FITTED_SHARE, compare, split
from benchmarks.recording.drives import Plan, line_distance, record

from ds_driver.data.recordings import Reading
from ds_recording.floor_camera import read_camera
from ds_recording.locate import located_of
from ds_recording.located import write_located
from ds_recording.recording import read_views
from ds_sim.registry import spec_of
from ds_sim.simulator import FRAME_TIME
from ds_twin_donkey.logs import read_log
from ds_twin_donkey.parameters import SCALE, DonkeyParameters

SEED, FRAMES = 101, 1000
"""Seed of the cars, and images of each: 50 s, three fifths of which are fitted."""
RANGES = {
    "max_steering_angle": (math.radians(20.0), math.radians(40.0)),
    "servo_rate": (2.4, 7.0),
    "servo_lag": (1 / 60, 0.1),
    "command_delay": (1 / 60, 0.2),
    "mass": (1.0, 2.4),
    "friction": (0.4, 1.05),
    "steering_trim": (-0.05, 0.05),
}
"""Ranges of the cars' parameters, uniform, fixed before the first drive. Chosen: from a linkage that binds, a network
that drives over Wi-Fi and dust on the floor to the good end of what a hand builds; servos from half the rate of a cheap
one to a fast one's; a bare chassis to one with a lidar on top; trim of 3 degrees, as `Conditions.tyre_pull`."""


def made_car(number: int) -> DonkeyParameters:
    """Draw a car, the same one however many others are drawn; its inertia grows with the mass, as a uniform box's."""
    rng = np.random.default_rng([SEED, 1, number])
    values = {name: float(rng.uniform(*ends)) for name, ends in RANGES.items()}
    nominal = DonkeyParameters()
    grown = values["mass"] / nominal.mass
    inertia = {name: getattr(nominal, name) * grown for name in ("yaw_inertia", "roll_inertia", "pitch_inertia")}
    return nominal.changed(**values, **inertia)


def main() -> None:
    """Record, locate, fit, predict and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder for recordings")
    parser.add_argument("--cars", default="1,2,3")
    arguments = parser.parse_args()
    spec = spec_of("donkey")
    for number in map(int, arguments.cars.split(",")):
        car, folder = made_car(number), arguments.out / f"wide-{number:02d}"
        if not (folder / "truth.csv").exists():
            record(Plan(simulator="donkey", seed=SEED + number, course="loop", frames=FRAMES, car=car), folder)
        views = read_views(folder / "tub", Reading(whole=True))
        camera = read_camera(folder / "camera.yaml").scaled(1.0 / SCALE)
        located, _ = located_of(views, camera, line_distance(spec) / SCALE)
        write_located(folder / "located", located)
        print(
            f"{folder.name}: lock {car.max_steering_angle:.4f} rad, trim {car.steering_trim:.4f} rad, delay with the "
            f"camera's {car.command_delay + spec.camera.latency * FRAME_TIME:.4f} s, servo {car.servo_rate:.1f} rad/s "
            f"and {car.servo_lag:.3f} s, full duty {car.full_duty:.3f}, mass {car.mass:.2f} kg, friction "
            f"{car.friction:.2f}; speed {np.median(located.column('speed_mps')):.2f} m/s",
            flush=True,
        )
        compare(*split(read_log(folder / "located").drives, FITTED_SHARE), located)


if __name__ == "__main__":
    main()
