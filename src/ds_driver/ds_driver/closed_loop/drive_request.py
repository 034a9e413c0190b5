# SPDX-License-Identifier: Apache-2.0
"""A request for one drive, to this process, a local worker or another machine."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ds_driver.networks.driver_name import DriverName
from ds_road.files import road_from_json, road_to_json
from ds_sim.conditions.text import from_json
from ds_sim.registry import SimulatorName
from ds_sim.scenario import OfScenario, Scenario
from ds_sim.session import RunRecord
from ds_sim.simulator import Outcome, Reason


@dataclass(frozen=True)
class DriveRequest(OfScenario):
    """One scenario to drive; if `probed`, the contrast of the lines is measured, see `ds_sim.gates`."""

    scenario: Scenario
    driver: DriverName
    simulator: SimulatorName
    probed: bool = False

    def ended(self, outcome: Outcome, message: str, reason: Reason = Reason.NONE) -> RunRecord:
        """Make the record of a drive that ended without a frame."""
        return RunRecord(scenario=self.scenario, outcome=outcome, message=message, reason=reason)


def request_to_json(request: DriveRequest) -> dict[str, Any]:
    """Convert a request to a JSON value."""
    return {
        "simulator": request.simulator,
        "driver": str(request.driver),
        "road": road_to_json(request.road),
        "seed": request.seed,
        "conditions": request.conditions.changed,
        "probed": request.probed,
    }


def request_from_json(value: Mapping[str, Any]) -> DriveRequest:
    """Convert what `request_to_json` made to an equal request; a ValueError if the road or the conditions cannot be."""
    scenario = Scenario(road_from_json(value["road"]), from_json(value["conditions"]), seed=value["seed"])
    driver, simulator = DriverName.parse(value["driver"]), SimulatorName(value["simulator"])
    return DriveRequest(scenario, driver, simulator, probed=value["probed"])
