"""Earlier translations, which a discriminator sees besides the latest (Zhu et al. 2017, section 4)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


class ImagePool:
    """Keeps up to `size` images; a full pool returns an earlier one half of the time, and keeps the new one instead."""

    def __init__(self, size: int) -> None:
        self.size = size
        self.images: list[Tensor] = []

    def query(self, image: Tensor, rng: np.random.Generator) -> Tensor:
        """Return the image itself, or an earlier one in exchange.

        Args:
            image: (1, 3, rows, columns), without gradient.
            rng: source of all random numbers.
        """
        if len(self.images) < self.size:
            self.images.append(image)
            return image
        if not self.images or rng.random() < 0.5:
            return image
        index = int(rng.integers(len(self.images)))
        earlier, self.images[index] = self.images[index], image
        return earlier

    def state(self) -> Tensor:
        """Return the images as one tensor, for a checkpoint."""
        return torch.cat(self.images).cpu() if self.images else torch.zeros(0)

    def restore(self, state: Tensor, device: torch.device) -> None:
        """Take the images of a checkpoint."""
        self.images = [image.contiguous(memory_format=torch.channels_last) for image in state.to(device).split(1)]
