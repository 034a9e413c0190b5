"""Times generation, validation and mutation of roads: `python benchmarks/roads.py [count]`."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "src" / "ds_road"))  # run without the workspace

from ds_road import Road, generate, mutate  # noqa: E402


def timed(name: str, calls: list[Callable[[], object]]) -> None:
    """Print percentiles of the times of some calls."""
    milliseconds = []
    for call in calls:
        started = time.perf_counter()
        call()
        milliseconds.append(1e3 * (time.perf_counter() - started))
    median, high, maximum = np.percentile(milliseconds, [50, 95, 100])
    print(f"{name:<24} median {median:6.2f} ms   95 % {high:6.2f} ms   max {maximum:6.2f} ms   ({len(calls)} roads)")


def main() -> None:
    """Measure at the paper's maximum angle of 270 degrees."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 300
    rngs = [np.random.default_rng(seed) for seed in range(count)]
    roads = [generate(rng) for rng in rngs]
    points = [road.control_points for road in roads]
    timed("generate and validate", [lambda rng=rng: generate(rng) for rng in rngs])  # type: ignore[misc]
    timed("validate", [lambda p=p: Road(p).validity for p in points])  # type: ignore[misc]
    timed("mutate and validate", [lambda r=r, g=g: mutate(r, g) for r, g in zip(roads, rngs, strict=True)])  # type: ignore[misc]


if __name__ == "__main__":
    main()
