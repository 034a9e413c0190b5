# SPDX-License-Identifier: Apache-2.0
"""Compares what the bits of a result depend on, between this machine and one that is to drive for it.

BLAS and LAPACK, whose kernels depend on the model of the processor, are not compared: no drive calls them.
"""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Collection, Mapping
from importlib.util import find_spec
from pathlib import Path

from ds_base.bounded_file import read_regular
from ds_base.installation import CPUINFO, processor_flags, versions
from ds_sim.registry import SIMULATORS, SimulatorName, UnknownSimulatorError, simulator_class

CODE = ("ds_base", "ds_road", "ds_sim", "ds_driver", *(target.partition(".")[0] for target in SIMULATORS.values()))
"""Packages whose code takes part in a drive."""
LIBRARIES = ("numpy", "numba", "opencv-python-headless", "pybullet", "pymunk", "shapely")
"""Libraries that take part in every drive."""
BACKENDS = {"onnxruntime": ("onnx",), "openvino": ("openvino",), "torch": ("torch",)}
"""Library -> beginnings of the back ends that compute with it."""
PROCESSOR_FEATURES = "processor features"
_FEATURES = ("sse4", "avx", "fma", "f16c", "amx", "asimd", "sve", "bf16")
"""Beginnings of the processor features by which libraries choose their kernels, and so their roundings."""
_FLOATING_POINT = frozenset(
    ("sse4_1", "sse4_2", "avx", "avx2", "fma", "f16c", "avx512f", "avx512cd", "avx512bw", "avx512dq", "avx512vl")
)
"""Those of x86-64 by which NumPy, OpenCV and ONNX Runtime compute in single and double precision; the other back ends
also use those for other formats, such as avx512_bf16."""


def fingerprint(backend: str, simulators: Collection[SimulatorName]) -> dict[str, str]:
    """What two machines must have in common to compute the same bits: name -> value.

    The back end is `onnx`, `openvino`, `openvino-bf16`, `torch`, or "" for a driver without a network.
    """
    installed_versions = versions()
    libraries = [*LIBRARIES, *(name for name, of in BACKENDS.items() if backend.startswith(of))]
    return {
        "code of Digital Siblings": code_sha256()[:12],
        "python": ".".join(installed_versions["python"].split(".")[:2]),
        **{name: installed_versions[name] for name in libraries},
        **{name: value for simulator in simulators for name, value in _of_simulator(simulator).items()},
        "machine": installed_versions["machine"],
        PROCESSOR_FEATURES: _processor_features(backend),
    }


def differences(here: Mapping[str, str], there: Mapping[str, str]) -> str:
    """Describe in one line what differs; "" if nothing does."""
    lines = []
    for name in here:
        mine, other = here[name], there.get(name, "unknown")
        if mine == other:
            continue
        if name == PROCESSOR_FEATURES:  # sets of words: name only what one side lacks
            ours, theirs = set(mine.split()), set(other.split())
            missing = [f"without {' '.join(sorted(ours - theirs))}"] if ours - theirs else []
            extra = [f"with {' '.join(sorted(theirs - ours))}"] if theirs - ours else []
            lines.append(f"{name} {' and '.join(missing + extra)}")
        else:
            lines.append(f"{name} {other} there, {mine} here")
    return "; ".join(lines)


def _of_simulator(name: SimulatorName) -> dict[str, str]:
    """What the bits of a simulator's drives depend on, with its code unless that is in `CODE`."""
    base = name.base
    try:
        kind = simulator_class(base)
    except UnknownSimulatorError:
        return {f"simulator {base}": "absent"}
    package = kind.__module__.partition(".")[0]
    code = {} if package in CODE else {f"code of {package}": code_sha256([package])[:12]}
    return {**code, **kind.depends_on()}


def code_sha256(packages: Collection[str] = CODE) -> str:
    """Digest of the source code of packages."""
    digest = hashlib.sha256()
    for package in dict.fromkeys(packages):
        spec = find_spec(package)
        if spec is None or spec.origin is None:
            digest.update(f"{package} is missing".encode())
            continue
        path = Path(spec.origin)
        for file in sorted(path.parent.rglob("*.py")) if spec.submodule_search_locations else [path]:
            digest.update(f"{package}/{file.relative_to(path.parent)}\n".encode())
            digest.update(read_regular(file))
    return digest.hexdigest()


def _processor_features(backend: str, cpuinfo: Path = CPUINFO) -> str:
    flags = processor_flags(cpuinfo)
    if not flags:
        return platform.processor() or "unknown"
    features = {flag for flag in flags if flag.startswith(_FEATURES)}
    if backend in ("", "onnx"):
        features = features & _FLOATING_POINT or features  # all of another architecture's
    return " ".join(sorted(features))
