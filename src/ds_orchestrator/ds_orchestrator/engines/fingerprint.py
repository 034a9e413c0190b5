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

from ds_base.installation import CPUINFO, processor_flags, versions
from ds_sim.registry import SimulatorName, UnknownSimulatorError, spec_of
from ds_sim.simulator import SimulatorError

CODE = (
    "ds_base", "ds_road", "ds_sim", "ds_driver", "ds_sim_bullet", "ds_sim_softbody", "ds_sim_panda", "ds_sim_torcs",
    "ds_sim_ros", "ds_twin_donkey", "ds_recording",
)  # fmt: skip
"""Packages whose code takes part in a drive."""
LIBRARIES = ("numpy", "numba", "opencv-python-headless", "pybullet", "pymunk", "shapely")
"""Libraries that take part in every drive."""
LIBRARIES_OF_PANDA = ("panda3d", "commonroad-vehicle-models")
"""Libraries that take part in drives with the simulator `panda`."""
BACKENDS = {"onnxruntime": ("onnx", "openvino-int8"), "openvino": ("openvino",), "torch": ("torch",)}
"""Library -> beginnings of the back ends that compute with it; ONNX Runtime also quantises."""
PROCESSOR_FEATURES = "processor features"
_FEATURES = ("sse4", "avx", "fma", "f16c", "amx", "asimd", "sve", "bf16")
"""Beginnings of the processor features by which libraries choose their kernels, and so their roundings."""
_FLOATING_POINT = frozenset(
    ("sse4_1", "sse4_2", "avx", "avx2", "fma", "f16c", "avx512f", "avx512cd", "avx512bw", "avx512dq", "avx512vl")
)
"""Those of x86-64 by which NumPy, OpenCV and ONNX Runtime compute in single and double precision; the other back ends
also use those for other formats, such as avx512_bf16."""


def fingerprint(backend: str, simulators: Collection[str]) -> dict[str, str]:
    """What two machines must have in common to compute the same bits: name -> value.

    Args:
        backend: `onnx`, `openvino`, `openvino-bf16`, `openvino-int8`, `torch`, or "" for a driver without a network.
        simulators: names of the simulators.
    """
    known = versions()
    with_panda, with_torcs = _drives("panda", simulators), _drives("torcs", simulators)
    libraries = [
        *LIBRARIES,
        *(name for name, of in BACKENDS.items() if backend.startswith(of)),
        *(LIBRARIES_OF_PANDA if with_panda else ()),
    ]
    return {
        "code of Digital Siblings": code_sha256()[:12],
        "python": ".".join(known["python"].split(".")[:2]),
        **{name: known[name] for name in libraries},
        **({"renderer": _renderer()} if with_panda else {}),
        **({"TORCS": _torcs()} if with_torcs else {}),
        "machine": known["machine"],
        PROCESSOR_FEATURES: _processor_features(backend),
    }


def differences(here: Mapping[str, str], there: Mapping[str, str]) -> str:
    """Describe in one line what differs; "" if nothing does."""
    found = []
    for name in here:
        mine, other = here[name], there.get(name, "unknown")
        if mine == other:
            continue
        if name == PROCESSOR_FEATURES:  # sets of words: name only what one side lacks
            ours, theirs = set(mine.split()), set(other.split())
            missing = [f"without {' '.join(sorted(ours - theirs))}"] if ours - theirs else []
            extra = [f"with {' '.join(sorted(theirs - ours))}"] if theirs - ours else []
            found.append(f"{name} {' and '.join(missing + extra)}")
        else:
            found.append(f"{name} {other} there, {mine} here")
    return "; ".join(found)


def _drives(name: str, simulators: Collection[str]) -> bool:
    """Whether a shipped simulator is among some, by its name or its class."""
    return any(SimulatorName.parse(one).base == name or f"ds_sim_{name}" in one for one in simulators)


def _torcs() -> str:
    """Versions of TORCS and of the library that draws for it; "absent" where it is not built."""
    try:
        return spec_of("torcs").engine
    except (UnknownSimulatorError, SimulatorError):
        return "absent"


def _renderer() -> str:
    """Version of the library that draws the images of `panda`; "absent" where it cannot draw."""
    from ds_sim_panda.scene.graphics import renderer_name

    try:
        return renderer_name()
    except (ImportError, SimulatorError):
        return "absent"


def code_sha256() -> str:
    """Digest of the source code of every package in `CODE`, and of the images by which networks are quantised."""
    digest = hashlib.sha256()
    for package in CODE:
        spec = find_spec(package)
        if spec is None or spec.origin is None:
            digest.update(f"{package} is missing".encode())
            continue
        folder = Path(spec.origin).parent
        for path in sorted([*folder.rglob("*.py"), *folder.glob("models/calibration/*")]):
            digest.update(f"{package}/{path.relative_to(folder)}\n".encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()


def _processor_features(backend: str, cpuinfo: Path = CPUINFO) -> str:
    flags = processor_flags(cpuinfo)
    if not flags:
        return platform.processor() or "unknown"
    found = {flag for flag in flags if flag.startswith(_FEATURES)}
    if backend in ("", "onnx"):
        found = found & _FLOATING_POINT or found  # all of another architecture's
    return " ".join(sorted(found))
