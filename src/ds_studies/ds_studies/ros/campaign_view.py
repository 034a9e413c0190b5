# SPDX-License-Identifier: Apache-2.0
"""Topics and services by which the orchestrator shows a goal: state, outcomes, maps, tests."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue

import numpy as np
from ds_interfaces.msg import CampaignState, MapLegend, TestOutcome
from ds_interfaces.srv import GetMap, GetState, GetTest
from nav_msgs.msg import OccupancyGrid
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile

from ds_analysis.paper.campaign_contents import maps_of
from ds_base.folder_files import StoreError
from ds_orchestrator.campaign.config import ConfigError
from ds_orchestrator.campaign.folder import CampaignData, open_store, read_campaign
from ds_orchestrator.campaign.time_left import TimedListener
from ds_orchestrator.maps.feature_map import FeatureMap, compared_ids
from ds_orchestrator.search.features import feature_of
from ds_orchestrator.store.model import Execution, Test
from ds_sim.gates.gate import Gate
from ds_sim.registry import SimulatorName, label_of
from ds_sim.ros.conversions import conditions_to_messages, road_to_message
from ds_sim.ros.diagnostics import ERROR, OK, WARN, Diagnostics, Report

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


class StateListener(TimedListener):
    """Counts a goal's drives, and keeps their outcomes until they are published."""

    def __init__(self, folder: str) -> None:
        super().__init__()
        self._state = CampaignState(state=CampaignState.RUNNING, folder=folder)
        self.outcomes: SimpleQueue[TestOutcome] = SimpleQueue()

    def stage(self, name: str) -> None:
        """See `Listener.stage`."""
        super().stage(name)
        with self._lock:
            self._state.stage = name

    def finished(self, test: Test, simulator: SimulatorName, execution: Execution | Gate | None, fresh: bool) -> None:
        """See `Listener.finished`."""
        with self._lock:
            super().finished(test, simulator, execution, fresh)
            self._state.failures += isinstance(execution, Execution) and execution.outcome.is_failure
            self._state.errors += execution is None
        self.outcomes.put(outcome_message(self._state.folder, test.test_id, simulator, execution))

    def hear(self, line: str) -> None:
        """Make a line of the product's loggers the state's message."""
        with self._lock:
            self._state.message = line

    def end(self, state: int, message: str) -> None:
        """Set how the goal ended."""
        with self._lock:
            self._state.state, self._state.message = state, message
        self.driven()

    @property
    def state(self) -> CampaignState:
        """Present state."""
        with self._lock:
            left = self.seconds_left()
            counted = {"done": self.done, "expected": self.total, "seconds_left": -1.0 if left is None else left}
            fields = self._state.get_fields_and_field_types()
            return CampaignState(**{name: getattr(self._state, name) for name in fields} | counted)


MAPS_EVERY, MAPS_SHARE = 2.0, 20.0
"""Seconds between two drawings of the maps, at least so many times what one takes; chosen: drives are not slowed."""
REMEMBERED = 1000
"""Outcomes that a late subscriber gets; chosen."""
MEETING = 5.0
"""Longest wait for the subscribers to outcomes to meet the publisher of another goal's, s."""


class CampaignView:
    """Shows one goal after the other; `warning` says what is wrong with the node itself, "" for nothing."""

    def __init__(self, node: Node, warning: Callable[[], str]) -> None:
        self._node, self._warning = node, warning
        self._listener: StateListener | None = None
        self._campaign: Path | None = None
        self._grids: Grids | None = None
        self._published, self._ended, self._lock = threading.Event(), threading.Event(), threading.Lock()
        self._latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._state = node.create_publisher(CampaignState, "campaign_state", self._latched)
        self._legend = node.create_publisher(MapLegend, "map_legend", self._latched)
        self._outcomes, self._awaited, self._patience = self._make_outcomes(), 0, 0.0
        Diagnostics(node, "campaign", self._report)
        self._maps = {"merged": node.create_publisher(OccupancyGrid, "maps/merged", self._latched)}
        node.create_service(GetState, "get_state", self._on_get_state)
        node.create_service(GetMap, "get_map", self._on_get_map)
        node.create_service(GetTest, "get_test", self._on_get_test)
        threading.Thread(target=self._keep_drawing, name="maps", daemon=True).start()
        self.show()

    def begin(self, listener: StateListener, campaign: Path | None) -> None:
        """Show a goal from now on; no maps are drawn of given tests, which have no folder of a campaign."""
        # A late subscriber must not get what the publishers remember of the last goal. No publisher can forget: that of
        # outcomes is replaced, those of maps, which remember one, publish one without cells.
        self.show()
        self._outcomes.wait_for_all_acked(Duration(seconds=1))
        self._awaited, self._patience = self._outcomes.get_subscription_count(), time.monotonic() + MEETING
        self._node.destroy_publisher(self._outcomes)
        self._outcomes = self._make_outcomes()
        for publisher in self._maps.values():
            publisher.publish(OccupancyGrid())
        self._legend.publish(MapLegend())
        with self._lock:
            self._listener, self._campaign, self._grids = listener, campaign, None

    def _make_outcomes(self) -> Publisher:
        remembered = QoSProfile(depth=REMEMBERED, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        return self._node.create_publisher(TestOutcome, "finished_tests", remembered)

    def close(self) -> None:
        """End the drawing of maps."""
        self._ended.set()

    @property
    def state(self) -> CampaignState:
        """Present state."""
        return CampaignState(seconds_left=-1.0) if self._listener is None else self._listener.state

    def show(self) -> None:
        """Publish what is new."""
        state = self.state
        met = self._outcomes.get_subscription_count() >= self._awaited or time.monotonic() > self._patience
        while met and self._listener is not None and not self._listener.outcomes.empty():
            self._outcomes.publish(self._listener.outcomes.get())
        self._state.publish(state)
        grids = self._grids
        if grids is not None and not self._published.is_set():
            self._published.set()
            self._legend.publish(grids.legend)
            for name, grid in grids.grids.items():
                if name not in self._maps:
                    self._maps[name] = self._node.create_publisher(OccupancyGrid, f"maps/{name}", self._latched)
                grid.header.stamp = grid.info.map_load_time = self._node.get_clock().now().to_msg()
                self._maps[name].publish(grid)

    def _report(self) -> Report:
        state, warning = self.state, self._warning()
        broken, doubtful = state.state == CampaignState.BROKEN, state.errors > 0 or bool(warning)
        numbers = ("done", "expected", "failures", "errors", "seconds_left")
        values = {"folder": state.folder} | {name: f"{getattr(state, name):g}" for name in numbers}
        text = warning or state.message or state.stage or "waits for a goal"
        return ERROR if broken else WARN if doubtful else OK, text, values

    def _keep_drawing(self) -> None:
        """Draw the maps again while a campaign drives, and once at its end."""
        pause, drawn = MAPS_EVERY, (0, -1, -1)
        while not self._ended.wait(pause):
            state, campaign = self.state, self._campaign
            present = (id(self._listener), state.done, state.state)
            if campaign is None or present == drawn:
                continue
            began, drawn = time.monotonic(), present
            listener, data = self._listener, self._read()
            grids = None if data is None else grids_of(data)
            with self._lock:
                if data is not None and listener is self._listener:
                    self._grids = grids
                    self._published.clear()
            pause = max(MAPS_EVERY, MAPS_SHARE * (time.monotonic() - began))

    def _read(self) -> CampaignData | None:
        if self._campaign is None:
            return None
        try:
            with closing(open_store(self._campaign)) as store:
                return read_campaign(store)
        except (StoreError, ConfigError, OSError):
            return None  # it has not begun, or cannot be read: the goal says so

    def _on_get_state(self, _: GetState.Request, response: GetState.Response) -> GetState.Response:
        response.state = self.state
        return response

    def _on_get_map(self, request: GetMap.Request, response: GetMap.Response) -> GetMap.Response:
        grids = self._grids
        if grids is None:
            response.message = "no campaign of this node has a map yet: send the goal run_campaign first"
            return response
        response.names, response.legend = list(grids.grids), grids.legend
        if request.name in grids.grids:
            response.found = True
            response.grid, response.tests = grids.grids[request.name], grids.tests[request.name]
        elif request.name:
            response.message = f"no map {request.name!r:.60}: expected one of {', '.join(grids.grids)}"
        return response

    def _on_get_test(self, request: GetTest.Request, response: GetTest.Response) -> GetTest.Response:
        data = self._read()
        if data is None:
            response.message = "no campaign of this node has tests yet: send the goal run_campaign first"
            return response
        return test_response(data, self.state.folder, request.test_id, response)
