"""Checks that the physics stay finite and bounded during an hour of simulated time at full throttle and full lock.

`python -m benchmarks.endurance [--minutes 60] [--sims softbody]` prints one row per simulator, as Markdown. The
steering changes sides every minute.
"""

from __future__ import annotations

import argparse
import dataclasses
import math

import numpy as np
from benchmarks.headless import cars

from ds_sim.simulator import FRAME_RATE, Command


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--minutes", type=int, default=60)
    parser.add_argument("--sims", default="softbody")
    arguments = parser.parse_args()
    print("| simulator | minutes | pace, m/s (first minute, last minute) | roll, deg (largest) | all finite |")
    print("|---|---|---|---|---|")
    for name in arguments.sims.split(","):
        vehicle = cars()[name].make(1)
        vehicle.reset(0.0, 0.0, 0.0, np.random.default_rng(0))
        paces, roll, finite = [], 0.0, True
        for minute in range(arguments.minutes):
            command = Command(-1.0 if minute % 2 else 1.0, 1.0)
            for _ in range(round(60 * FRAME_RATE)):
                vehicle.advance(command)
                state = vehicle.state()
                roll = max(roll, abs(state.roll))
                finite = finite and all(math.isfinite(v) for v in dataclasses.astuple(state))
            paces.append(math.hypot(state.speed, state.lateral_speed))
        vehicle.close()
        print(
            f"| {name} | {arguments.minutes} | {paces[0]:.2f}, {paces[-1]:.2f} | {math.degrees(roll):.1f} | "
            f"{'yes' if finite else 'no'} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
