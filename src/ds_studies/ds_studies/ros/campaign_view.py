# SPDX-License-Identifier: Apache-2.0
"""Topics and services by which the orchestrator shows a goal: state, outcomes, maps, tests."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from ds_interfaces.msg import CampaignState, MapLegend, TestOutcome
from ds_interfaces.srv import GetMap, GetState, GetTest
from nav_msgs.msg import OccupancyGrid
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile

from ds_base.folder_files import StoreError
from ds_orchestrator.campaign.config import ConfigError
from ds_orchestrator.campaign.folder import CampaignData, open_store, read_campaign
from ds_sim.ros.diagnostics import ERROR, OK, WARN, Diagnostics, Report
from ds_studies.ros.campaign_messages import Grids, grids_of, stamped, test_response
from ds_studies.ros.goals import Job

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
        self._job: Job | None = None
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

    def begin(self, job: Job, campaign: Path | None) -> None:
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
            self._job, self._campaign, self._grids = job, campaign, None

    def _make_outcomes(self) -> Publisher:
        remembered = QoSProfile(depth=REMEMBERED, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        return self._node.create_publisher(TestOutcome, "finished_tests", remembered)

    def close(self) -> None:
        """End the drawing of maps."""
        self._ended.set()

    @property
    def state(self) -> CampaignState:
        """Present state."""
        return CampaignState(seconds_left=-1.0) if self._job is None else self._job.listener.state

    def show(self) -> None:
        """Publish what is new."""
        state = self.state
        met = self._outcomes.get_subscription_count() >= self._awaited or time.monotonic() > self._patience
        while met and self._job is not None and not self._job.listener.outcomes.empty():
            self._outcomes.publish(self._job.listener.outcomes.get())
        self._state.publish(state)
        grids = self._grids
        if grids is not None and not self._published.is_set():
            self._published.set()
            self._legend.publish(grids.legend)
            for name, grid in grids.grids.items():
                if name not in self._maps:
                    self._maps[name] = self._node.create_publisher(OccupancyGrid, f"maps/{name}", self._latched)
                self._maps[name].publish(stamped(grid, self._node.get_clock().now().to_msg()))

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
            present = (id(self._job), state.done, state.state)
            if campaign is None or present == drawn:
                continue
            began, drawn = time.monotonic(), present
            job, data = self._job, self._read()
            grids = None if data is None else grids_of(data)
            with self._lock:
                if data is not None and job is self._job:
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
