# SPDX-License-Identifier: Apache-2.0
"""Executions of tests that no simulator has driven."""

from __future__ import annotations

from ds_orchestrator.store.model import NO_DRIVE, DriveArrays, Execution
from ds_sim import SimulatorName
from ds_sim.simulator import FRAME_TIME, Outcome


def made_execution(
    test_id: str,
    simulator: str,
    outcome: Outcome,
    largest: float = 0.0,
    *,
    steps: int = 1,
    drive: DriveArrays = NO_DRIVE,
) -> Execution:
    """An execution whose largest lateral position is `largest`, m."""
    return Execution(
        test_id=test_id,
        simulator=SimulatorName(simulator),
        outcome=outcome,
        message="",
        fitness=2.0 - largest,
        max_lateral_position=largest,
        steps=steps,
        simulated_seconds=steps * FRAME_TIME,
        trajectory_sha256="",
        drive=drive,
    )
