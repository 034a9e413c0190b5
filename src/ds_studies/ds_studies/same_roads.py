# SPDX-License-Identifier: Apache-2.0
"""Drives the same roads with one driver on several simulators, for what a sibling adds."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory

from ds_analysis.common.driven_road import DrivenRoad
from ds_orchestrator.campaign.engine import DriveSettings
from ds_orchestrator.engines.drive_tests import Callbacks, DriveResults, Unfinished, drive_tests
from ds_orchestrator.store.model import Test
from ds_road import Road
from ds_sim.registry import SimulatorName
from ds_sim.scenario import Scenario
from ds_sim.simulator import Outcome


def drive_same_roads(
    settings: DriveSettings, roads: Sequence[Road], seed: int, folder: Path | None, callbacks: Callbacks
) -> dict[SimulatorName, list[DrivenRoad]]:
    """Drive roads on every simulator, the first with this seed, which increases by one per road.

    A stopped call goes on in its folder, with other roads, too; None keeps nothing. Errors are as in
    `ds_orchestrator.engines.drive_tests.drive_tests`.

    Returns:
        Simulator -> what became of the roads, in their order; what a simulator cannot realise ends in an error.
    """
    tests = [Test(f"{road.road_id}-{seed + k}", Scenario(road, seed=seed + k)) for k, road in enumerate(roads)]
    with nullcontext(folder) if folder is not None else TemporaryDirectory(prefix="ds_roads_") as place:
        results = drive_tests(settings, dict.fromkeys(settings.simulators, tests), Path(place), callbacks)
        return {
            name: [
                driven_road(results, test, name) or DrivenRoad(road=test.road, outcome=Outcome.SIM_ERROR)
                for test in tests
            ]
            for name in settings.simulators
        }


def driven_road(results: DriveResults, test: Test, simulator: SimulatorName) -> DrivenRoad | None:
    """What became of a test on a simulator; None if it was not driven, or excluded."""
    key = test.test_id, simulator
    if key in results.executions:
        return DrivenRoad.of_execution(test.road, results.executions[key])
    error = results.errors.get(key, Unfinished()).outcome
    return None if error is None else DrivenRoad(road=test.road, outcome=error)
