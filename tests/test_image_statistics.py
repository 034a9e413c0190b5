# SPDX-License-Identifier: Apache-2.0
"""Compares image statistics with closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from benchmarks.image_statistics import image_statistics


def test_white_noise_has_its_known_contrast_and_sharpness() -> None:
    """The Laplacian of white noise has sqrt(4^2 + 4) times its standard deviation."""
    grey = np.random.default_rng(1).normal(120.0, 10.0, (160, 320, 1)).round().astype(np.uint8)
    found = image_statistics(np.repeat(grey, 3, axis=2))
    assert found.brightness == pytest.approx(120.0, abs=0.3)
    assert found.contrast == pytest.approx(10.0, rel=0.02)
    assert found.sharpness == pytest.approx(20**0.5, rel=0.02)
    assert found.noise_fineness == pytest.approx(48 / 61, abs=0.03)


def test_a_bad_image_is_refused() -> None:
    with pytest.raises(ValueError, match="expected"):
        image_statistics(np.zeros((4, 4, 3), np.uint8))
