# SPDX-License-Identifier: Apache-2.0
"""Drives give the same bytes with every kernel of BLAS: they call none.

OpenBLAS chooses its kernels by the type of processor, and each rounds the products of matrices in its own way.
"""

from __future__ import annotations

import ast
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
BLAS = {
    "cholesky", "cond", "convolve", "corrcoef", "correlate", "cov", "det", "dot", "eig", "eigh", "inner", "inv",
    "lstsq", "matmul", "matrix_power", "matrix_rank", "matvec", "pinv", "polyfit", "qr", "slogdet", "solve", "svd",
    "tensordot", "vdot", "vecdot", "vecmat",
}  # fmt: skip
"""Functions of NumPy that call BLAS or LAPACK; so do `@`, `einsum` with `optimize`, and `norm` without `axis`."""
FRAMES = 15
NOT_DRIVEN = {"fit.py", "residuals.py", "windows.py", "picture.py"}
"""Modules that are imported with those of a drive: the fit of the twin's parameters, the picture of a road."""
WET = {"visibility": 60.0, "low_sun": 4000.0, "lens_dirt": 0.1, "camera_yaw": 0.05, "friction": 0.6, "payload": 0.2}
WORN = {"shadow_density": 0.4, "repair_share": 0.2, "line_cover": 0.2, "pavement_reflectance": 0.2}


def drive() -> dict[str, Any]:
    """Drive a little with every simulator; for each run a digest, and what was imported for them."""
    import numpy as np
    from threadpoolctl import threadpool_info

    from ds_driver.closed_loop.simulation import make_driver
    from ds_road import generate
    from ds_sim.conditions.model import Conditions
    from ds_sim.gates.visible_contrast import ContrastProbe
    from ds_sim.registry import STANDARD, make_simulator, simulators
    from ds_sim.session import Session
    from ds_sim.testing import missing_because

    road, digests = generate(np.random.default_rng(2)), {}
    for name in (name for name in simulators() if name in STANDARD or not missing_because(name)):
        simulator = make_simulator(name)
        for driver, values in (("dave2_short", {}), ("autopilot", WET), ("dave2_short", WORN)):
            conditions = Conditions(**{k: v for k, v in values.items() if k in simulator.spec.conditions})
            command, session, digest = make_driver(driver, simulator.spec), Session(simulator), hashlib.sha256()
            observation = session.start(road, 3, conditions)
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
    files = [module.__file__ for name, module in sys.modules.items() if name.startswith("ds_") and module.__file__]
    cores = sorted({info["architecture"] for info in threadpool_info() if "numpy" in info["filepath"]})
    return {"digests": digests, "files": sorted(files), "cores": cores}


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


def test_no_module_of_a_drive_calls_blas() -> None:
    """Also where kernels happen to round alike."""
    files = [Path(name) for name in driven_with("Haswell")["files"] if Path(name).name not in NOT_DRIVEN]
    assert len(files) > 50
    found = [f"{path.name}:{line}: {call}" for path in files for line, call in calls_of_blas(path)]
    assert not found, found


def calls_of_blas(path: Path) -> list[tuple[int, str]]:
    found = []
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.BinOp | ast.AugAssign) and isinstance(node.op, ast.MatMult):
            found.append((node.lineno, "@"))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            name, given = node.func.attr, {word.arg for word in node.keywords}
            if name in BLAS or (name == "norm" and "axis" not in given) or (name == "einsum" and "optimize" in given):
                found.append((node.lineno, ast.unparse(node.func)))
    return found


if __name__ == "__main__":
    print(json.dumps(drive()))
