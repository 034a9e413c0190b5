# SPDX-License-Identifier: Apache-2.0
"""Synthetic campaigns, without simulators, for the tests of the report."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from made_executions import made_execution

from ds_analysis.paper.campaign_contents import maps_of
from ds_analysis.paper.correlation import Correlation, evaluate
from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.folder import CampaignData, read_campaign
from ds_orchestrator.maps.feature_map import FeatureMap, MapCell, MapId
from ds_orchestrator.search.features import Cell
from ds_orchestrator.store.model import DriveArrays, Execution, Origin, Test
from ds_orchestrator.store.rows import trajectory_sha256
from ds_orchestrator.store.store import Store
from ds_report.build import write_report
from ds_road import Road, generate
from ds_sim import SimulatorName
from ds_sim.conditions.model import Conditions
from ds_sim.registry import label_of
from ds_sim.scenario import Scenario
from ds_sim.simulator import Outcome

EVIL = "nowhere:</script><script>alert('&')</script>"
"""Name of a simulator that cannot be created; it holds HTML that the page must escape."""
NOWHERE = CampaignConfig(siblings=["a:One", "b:Two"], twin=SimulatorName("c:Three"), seed=7)  # type: ignore[list-item]
"""Simulators that nobody can make, so that pages have no camera pictures."""


@cache
def road(seed: int) -> Road:
    return generate(np.random.default_rng(seed), max_angle=200)


def set_conditions(test: Test, conditions: Conditions) -> Test:
    return replace(test, scenario=replace(test.scenario, conditions=conditions))


def make_execution(test: Test, simulator: str, offset: float) -> Execution:
    """Create a drive along the right lane that drifts to the right until `offset` m; it ends outside the lane.

    Steering is as noisy as a network's, drawn from the names of test and simulator.
    """
    centre, across = test.road.lane_centre, (test.road.right_edge - test.road.left_edge) / (2 * 4.0)
    lateral = np.linspace(0.0, offset, len(centre))
    steps = int(np.argmax(lateral > 2.0)) + 1 if offset > 2.0 else len(centre)
    path = centre + lateral[:, None] * across
    trajectory = np.column_stack((path, np.zeros(len(path)), np.full(len(path), 8.0), lateral))[:steps]
    rng = np.random.default_rng(list(f"{test.test_id} {simulator}".encode()))
    worst = float(np.abs(trajectory[:, 4]).max())
    outcome = Outcome.OUT_OF_BOUNDS if worst > 2.0 else Outcome.COMPLETED
    drive = DriveArrays(trajectory, rng.normal(0.0, 0.05, steps - 1))
    made = made_execution(test.test_id, simulator, outcome, worst, steps=steps - 1, drive=drive)
    return replace(made, trajectory_sha256=trajectory_sha256(trajectory))


def make_tests(config: CampaignConfig, per_sibling: int, *, roads: int = 8) -> list[tuple[Test, list[Execution]]]:
    """Create the tests of the searches, each driven on every simulator."""
    rng = np.random.default_rng(5)
    made = []
    for k, sibling in enumerate(config.siblings):
        for number in range(per_sibling):
            test_id = f"{label_of(sibling)}-0-{number:04d}"
            chosen = road((len(config.siblings) * number + k) % roads)
            test = Test(test_id, Scenario(chosen, seed=3), Origin(sibling, 0, number))
            driven = [make_execution(test, name, float(rng.uniform(0.2, 2.6))) for name in config.simulators]
            made.append((test, driven))
    return made


def make_campaign(
    folder: Path,
    config: CampaignConfig,
    per_sibling: int,
    *,
    bags: bool = False,
    roads: int = 8,
    changed: Callable[[Test], Test] = lambda test: test,
) -> Store:
    """Create a store of such tests, each changed, with the name of a bag for each execution if `bags`."""
    store = Store(folder / "campaign.sqlite", config=config.model_dump_json())
    store.note("version numpy", "1.2.3<b>")
    for test, driven in make_tests(config, per_sibling, roads=roads):
        store.add_test(changed(test))
        for execution in driven:
            bag = f"bags/{test.test_id}-on-{label_of(execution.simulator)}" if bags else ""
            store.add_execution(replace(execution, bag=bag))
    return store


def campaign_data(folder: Path, config: CampaignConfig, per_sibling: int, *, roads: int = 8) -> CampaignData:
    with closing(make_campaign(folder, config, per_sibling, roads=roads)) as store:
        return read_campaign(store)


def make_map(map_id: MapId, cells: Mapping[Cell, tuple[float, float]]) -> FeatureMap:
    """Create a map of these probabilities and qualities, each of two tests."""
    values = {c: MapCell(tests=2, failures=None, probability=p, quality_loss=q) for c, (p, q) in cells.items()}
    return FeatureMap(id=map_id, cells=values)


def results(data: CampaignData) -> tuple[dict[MapId, FeatureMap], list[Correlation]]:
    config, maps = data.config, maps_of(data)
    return maps, evaluate(maps, config.siblings, config.twin) if config.twin else []


def report_of(folder: Path, store: Store) -> Path:
    """Write the report of a store, without intervals."""
    data = read_campaign(store)
    return write_report(folder, data, *results(data), trusted=data.config.simulators)
