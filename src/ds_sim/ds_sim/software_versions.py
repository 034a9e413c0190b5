"""Library versions recorded with each result."""

from __future__ import annotations

import platform
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version

_DISTRIBUTIONS = (
    "numpy", "scipy", "scikit-learn", "statsmodels", "opencv-python-headless", "torch", "onnxruntime", "openvino",
    "pybullet", "pymunk", "panda3d", "numba", "commonroad-vehicle-models", "shapely", "plotly",
)  # fmt: skip


def versions() -> dict[str, str]:
    """Versions of Python and of the libraries that results depend on, by name, and the machine type."""
    return dict(_versions())


@lru_cache(maxsize=1)  # each look-up parses a distribution's metadata
def _versions() -> dict[str, str]:
    found = {"python": platform.python_version(), "machine": platform.machine()}
    for name in _DISTRIBUTIONS:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found
