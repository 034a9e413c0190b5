# SPDX-License-Identifier: Apache-2.0
"""Drives give the same bytes with every kernel of BLAS: they call none.

OpenBLAS chooses its kernels by the type of processor, and each rounds the products of matrices in its own way.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

import pytest

AVX512 = {"avx512f", "avx512cd", "avx512bw", "avx512dq", "avx512vl"}
CORES = ("SkylakeX", "Haswell", "Prescott")
"""Types of processor whose kernels are compared: AVX-512, AVX2 with fused multiply-add, and neither."""
FRAMES = 6
WET = {"visibility": 60.0, "low_sun": 4000.0, "lens_dirt": 0.1, "camera_yaw": 0.05, "friction": 0.6, "payload": 0.2}
WORN = {"shadow_density": 0.4, "repair_share": 0.2, "line_cover": 0.2, "pavement_reflectance": 0.2}


def drive() -> dict[str, Any]:
    """Drive a little with every simulator; for each run a digest."""
    import numpy as np
    from threadpoolctl import threadpool_info

    from ds_driver.closed_loop.simulation import make_driver
    from ds_road import generate
    from ds_sim.conditions.model import Conditions
    from ds_sim.gates.visible_contrast import ContrastProbe
    from ds_sim.registry import STANDARD, make_simulator, simulators
    from ds_sim.scenario import Scenario
    from ds_sim.session import Session
    from ds_sim.testing import missing_because

    road, digests = generate(np.random.default_rng(2)), {}
    for name in (name for name in simulators() if name in STANDARD or not missing_because(name)):
        simulator = make_simulator(name)
        for driver, values in (("autopilot", WET), ("dave2_short", WORN)):
            conditions = Conditions(**{k: v for k, v in values.items() if k in simulator.spec.conditions})
            command, session, digest = make_driver(driver, simulator.spec), Session(simulator), hashlib.sha256()
            observation = session.start(Scenario(road, conditions, seed=3))
            assert session.run is not None
            probe = ContrastProbe(session.run, simulator)
            while observation is not None and observation.step < FRAMES:
                probe.see(observation)
                digest.update(observation.image.tobytes())
                digest.update(repr((observation.vehicle, observation.lane)).encode())
                observation = session.advance(command(observation))
            digest.update(repr(session.run.visible_contrasts).encode())
            digests[f"{name} {driver} {sorted(values)} {session.run.outcome.name}"] = digest.hexdigest()
        simulator.close()
    cores = sorted({info["architecture"] for info in threadpool_info() if "numpy" in info["filepath"]})
    return {"digests": digests, "cores": cores}


@cache
def driven_with(core: str) -> dict[str, Any]:
    environment = {**os.environ, "OPENBLAS_CORETYPE": core}
    done = subprocess.run([sys.executable, __file__], env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return dict(json.loads(done.stdout.splitlines()[-1]))


def test_drives_have_the_same_bytes_with_every_kernel() -> None:
    info = Path("/proc/cpuinfo")
    if not info.is_file() or not set(info.read_text("utf-8").split()) >= AVX512:
        pytest.skip("this processor cannot run all of OpenBLAS's kernels")
    first, *others = (driven_with(core) for core in CORES)
    assert all("RUNNING" in run for run in first["digests"]), first["digests"]
    for other in others:
        assert other["cores"] != first["cores"]
        assert other["digests"] == first["digests"]


if __name__ == "__main__":
    print(json.dumps(drive()))
