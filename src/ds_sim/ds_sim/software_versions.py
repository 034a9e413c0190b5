"""Which versions of what made a result."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version

_DISTRIBUTIONS = (
    "numpy", "scipy", "scikit-learn", "statsmodels", "opencv-python-headless", "torch", "onnxruntime", "openvino",
    "pybullet", "pymunk", "shapely", "plotly",
)  # fmt: skip


def versions() -> dict[str, str]:
    """Name -> version of Python, the kind of machine, and the libraries that a result depends on."""
    found = {"python": platform.python_version(), "machine": platform.machine()}
    for name in _DISTRIBUTIONS:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found
