# SPDX-License-Identifier: Apache-2.0
"""Accuracy of fitted parameters of the twin for noisy drives with known parameters and a start 30% off.

Prints a row per seed and parameter, then per parameter how many seeds are within 5% and inside the 95% interval.
`python -m benchmarks.twin_fit --seeds 1,2,3,4,5 --drives 12`; about half a minute per seed on an idle core.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from benchmarks.twin_drives import hidden_and_start, manoeuvres, simulated_recording

from ds_twin_donkey.fit import FITTED, fit
from ds_twin_donkey.parameters import DonkeyParameters

TRIM_SCALE = 0.05
"""Scale for errors of the trim, rad, because the trim may be 0."""


def main() -> None:
    """Fit the drives of every seed and print the tables."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", default="1,2,3,4,5")
    parser.add_argument("--drives", type=int, default=12, help="number of drives of 30.5 s each")
    arguments = parser.parse_args()
    close, inside, determined = (dict.fromkeys(FITTED, 0) for _ in range(3))
    seeds = [int(seed) for seed in arguments.seeds.split(",")]
    for seed in seeds:
        rng = np.random.default_rng(seed)
        hidden, start = hidden_and_start(list(FITTED), rng)
        nominal = DonkeyParameters()
        car = nominal.changed(**hidden)
        drives = [simulated_recording(car, rng, manoeuvres(rng)) for _ in range(arguments.drives)]
        began = time.process_time()
        fitted = fit(drives, nominal.changed(**start))
        print(f"seed {seed}: {fitted.windows} windows, {time.process_time() - began:.0f} s of CPU", flush=True)
        for e in fitted.estimates:
            true = hidden[e.name]
            size = TRIM_SCALE if e.name == "steering_trim" else true
            close[e.name] += abs(e.value - true) <= 0.05 * size
            inside[e.name] += e.low <= true <= e.high
            determined[e.name] += e.determined
            error, half = 100.0 * (e.value - true) / size, 100.0 * (e.high - e.value) / size
            print(
                f"  {e.name:20s} true {true:8.5f} found {e.value:8.5f} error {error:6.2f}% "
                f"interval +-{half:5.2f}% {e.status}"
            )
    print(f"{'of ' + str(len(seeds)) + ' seeds':22s} within 5%  in interval  determined")
    for name in FITTED:
        print(f"{name:22s} {close[name]:10d} {inside[name]:12d} {determined[name]:11d}")
    print(f"{'all':22s} {sum(close.values()):10d} {sum(inside.values()):12d} {sum(determined.values()):11d}")


if __name__ == "__main__":
    main()
