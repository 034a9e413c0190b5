# SPDX-License-Identifier: Apache-2.0
"""Tests that need TORCS are skipped where it is not built."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from ds_sim.testing import missing_because
from ds_sim_torcs.host import TorcsHost
from ds_sim_torcs.simulator import CAMERA


@pytest.fixture
def host() -> Iterator[TorcsHost]:
    """A host of TORCS, ended afterwards."""
    if reason := missing_because("torcs"):
        pytest.skip(reason)
    made = TorcsHost(CAMERA.width, CAMERA.height_px)
    yield made
    made.close()
