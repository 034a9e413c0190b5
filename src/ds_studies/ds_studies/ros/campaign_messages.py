# SPDX-License-Identifier: Apache-2.0
"""Messages about a campaign: tests, outcomes, and feature maps as occupancy grids."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from builtin_interfaces.msg import Time
from ds_interfaces.msg import MapLegend, TestOutcome
from ds_interfaces.srv import GetTest
from nav_msgs.msg import OccupancyGrid

from ds_analysis.paper.campaign_contents import maps_of
from ds_orchestrator.campaign.folder import CampaignData
from ds_orchestrator.maps.feature_map import FeatureMap, compared_ids
from ds_orchestrator.search.features import feature_of
from ds_orchestrator.store.model import Execution
from ds_sim.gates.gate import Gate
from ds_sim.registry import SimulatorName, label_of
from ds_sim.ros.conversions import conditions_to_messages, road_to_message

FRAME = "feature_map"
"""Frame of the grids: bins of the first feature along x, of the second along y; a cell is 1 m wide."""
MOST_CELLS = 2**16
"""Cells of a grid; chosen: a hundred times those of the paper's maps."""


def outcome_message(
    folder: str, test_id: str, simulator: SimulatorName, outcome: Execution | Gate | None
) -> TestOutcome:
    """Convert what became of a test of a goal's folder on a simulator; None: every attempt ended in an error."""
    message = TestOutcome(campaign=folder, test_id=test_id, simulator=simulator)
    if isinstance(outcome, Execution):
        message.outcome.value = int(outcome.outcome)
        message.message, message.bag = outcome.message, outcome.bag
        message.fitness, message.max_lateral_position = outcome.fitness, outcome.max_lateral_position
    elif isinstance(outcome, Gate):
        message.excluded, message.message = True, outcome.message
    else:
        message.message = "every attempt ended in an error"
    return message


def test_response(data: CampaignData, folder: str, test_id: str, response: GetTest.Response) -> GetTest.Response:
    """Fill in a test of a campaign, by the folder of its goal, and its outcomes."""
    test = next((one for one in data.tests if one.test_id == test_id), None)
    if test is None:
        example = data.tests[0].test_id if data.tests else "none yet"
        response.message = f"no test {test_id!r:.60}: expected one of {len(data.tests)}, such as {example}"
        return response
    response.found, response.road, response.seed = True, road_to_message(test.road), test.seed
    response.conditions = conditions_to_messages(test.conditions)
    outcomes: dict[SimulatorName, Execution | Gate] = {
        name: gate for (one, name), gate in data.gates.items() if one == test_id and not gate.is_valid
    }
    outcomes |= {one.simulator: one for one in data.verdicts if one.test_id == test_id}
    response.outcomes = [outcome_message(folder, test_id, name, one) for name, one in outcomes.items()]
    return response


@dataclass(frozen=True)
class Grids:
    """Maps of a campaign by name: failure probabilities in percent, tests of each cell; what all cells stand for."""

    grids: Mapping[str, OccupancyGrid]
    tests: Mapping[str, Sequence[int]]
    legend: MapLegend


def grids_of(data: CampaignData) -> Grids | None:
    """Build the maps that are compared (unions, merged, twin), over the first two features; None without a test."""
    maps = maps_of(data)
    chosen = {label_of(one.name).replace(".", "_").replace("-", "_"): maps[one] for one in compared_ids(maps)}
    cells = [cell[:2] for one in chosen.values() for cell in one.cells]
    if not cells:
        return None
    columns, rows = (range(min(bins), max(bins) + 1) for bins in zip(*cells, strict=True))
    if len(columns) * len(rows) > MOST_CELLS:
        return None
    grids, tests = {}, {}
    for name, one in chosen.items():
        grids[name], tests[name] = _grid(one, columns, rows)
    across, up = (feature_of(name) for name in data.config.features[:2])
    legend = MapLegend(
        across=across.title, up=up.title, columns=[*map(across.label, columns)], rows=[*map(up.label, rows)]
    )
    return Grids(grids, tests, legend)


def _grid(one: FeatureMap, columns: range, rows: range) -> tuple[OccupancyGrid, list[int]]:
    """Place a map's cells on a grid, row by row from below."""
    tests, failures = np.zeros((len(rows), len(columns)), np.int64), np.zeros((len(rows), len(columns)))
    for cell, content in one.cells.items():
        place = rows.index(cell[1]), columns.index(cell[0])
        tests[place] += content.tests
        failures[place] += content.tests * content.probability
    percent = np.where(tests > 0, np.rint(100.0 * failures / np.maximum(tests, 1)), -1.0)
    grid = OccupancyGrid()
    grid.header.frame_id = FRAME
    grid.info.resolution, grid.info.width, grid.info.height = 1.0, len(columns), len(rows)
    grid.info.origin.position.x, grid.info.origin.position.y = float(columns[0]), float(rows[0])
    grid.info.origin.orientation.w = 1.0
    grid.data = percent.astype(np.int8).ravel().tolist()
    return grid, tests.ravel().tolist()


def stamped(grid: OccupancyGrid, stamp: Time) -> OccupancyGrid:
    """Set the time of a grid."""
    grid.header.stamp = grid.info.map_load_time = stamp
    return grid
