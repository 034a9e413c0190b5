# SPDX-License-Identifier: Apache-2.0
"""Simulator that hangs during a run, for the tests of node shutdown."""

from __future__ import annotations

import time

from ds_sim.registry import make_simulator
from ds_sim.simulator import Command, Observation

_DONKEY = type(make_simulator("donkey"))


class Stuck(_DONKEY):  # type: ignore[misc, valid-type]
    def step(self, command: Command) -> Observation:
        print("stuck", flush=True)
        time.sleep(3600.0)
        return super().step(command)
